"""Benchmarks behind `drivesem bench`, with common scenes, timers and machine facts."""
