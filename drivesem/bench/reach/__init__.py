"""How far the gradient of a margin holds: beside the slope of the margin over steps of an attack."""
