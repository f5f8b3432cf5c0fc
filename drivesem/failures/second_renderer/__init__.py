"""Second renderers: the same scene drawn by something that shares no code with the compositor."""
