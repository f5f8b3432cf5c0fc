"""Re-tests counterexamples with a second renderer."""
