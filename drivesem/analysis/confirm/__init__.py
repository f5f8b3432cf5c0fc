"""Counterexamples drawn again by a second renderer."""
