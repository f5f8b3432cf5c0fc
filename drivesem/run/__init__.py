"""A run in the making and a finished one: its folder, its frames, its results, and what they add up to."""
