"""The HTML report of runs, from result files only."""
