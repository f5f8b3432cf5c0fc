"""Information worth and gain: how much counterexamples teach."""
