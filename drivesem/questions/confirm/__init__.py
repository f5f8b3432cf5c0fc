"""Counterexamples rendered again by the scene generator, the second renderer."""
