"""What is asked of runs and of detections. A question tells what it measures, and what its rows are."""
