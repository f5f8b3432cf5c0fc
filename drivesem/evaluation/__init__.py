"""Figures of detections against labels: average precision, recall, failures."""
