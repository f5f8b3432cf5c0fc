"""Results as one HTML page; sees result files only."""
