"""Recomputes a run from its files and compares."""
