"""Detections against labels: where both come from, and what is written of them."""
