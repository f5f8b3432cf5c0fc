"""The commands: each takes its settings, calls what does the work, prints the result and returns the exit code."""
