"""Computes detection metrics of detectors and prediction files."""
