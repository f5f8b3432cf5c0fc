"""Semantic counterexamples for driving detectors. Nothing heavy is imported here: see `drivesem.cli`."""

__version__ = "0.1.0"
