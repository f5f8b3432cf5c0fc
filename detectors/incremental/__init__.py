"""Incremental inference: a detector on an image with few changed regions, computing only what can differ."""
