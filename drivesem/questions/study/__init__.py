"""The paper's experiments repeated: arms, each an attack on the same frames, beside the paper's figures."""
