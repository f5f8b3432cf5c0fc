"""From a photograph with boxes to a scene: masks, geometry and textures."""
