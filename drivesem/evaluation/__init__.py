"""Detection metrics: average precision, recall, failures."""
