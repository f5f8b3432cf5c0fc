"""From a photograph with boxes to a scene: semantic, geometric and textural branch."""
