"""The differentiable renderer: `prepare`, then `reference` or `fast`, then `compositor`."""
