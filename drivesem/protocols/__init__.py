"""MAITE's object detection protocol for data sets, attacks and metrics; nothing of it is imported."""
