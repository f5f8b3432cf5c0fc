"""Editable 3D scenes made from photographs, and the differentiable renderer that draws them. Knows no detector."""
