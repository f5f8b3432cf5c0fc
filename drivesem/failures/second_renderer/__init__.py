"""Second renderers: they render a scene again without sharing code with the compositor."""
