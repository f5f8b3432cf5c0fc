"""`drivesem study classification`: the paper's tables for classifiers."""
