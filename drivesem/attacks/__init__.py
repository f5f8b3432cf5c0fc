"""From a scene and a detector to a counterexample: what may move, how far, what is aimed at, what counts."""
