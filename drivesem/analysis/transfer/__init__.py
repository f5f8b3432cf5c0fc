"""Tests counterexamples on other detectors."""
