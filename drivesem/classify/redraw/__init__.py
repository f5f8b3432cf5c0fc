"""Objects drawn by other renderers than the project's own, with the same lights and materials."""
