"""A yardstick for what looks for failures: faults that are known, planted where a frame's cars can be brought."""
