"""Whether a finished run is what it says it is: every frame computed again from its files."""
