"""A run as one HTML page, and its failures in words and pictures; sees result files only."""
