"""A detector on a picture of which a few regions have changed: only those are computed again."""
