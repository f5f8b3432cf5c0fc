"""Scenes taken apart, and the differentiable renderer that puts them together again. Knows no detector."""
