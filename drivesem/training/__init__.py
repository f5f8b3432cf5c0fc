"""Training of detectors: data, losses, the training loop, checkpoints and model cards."""
