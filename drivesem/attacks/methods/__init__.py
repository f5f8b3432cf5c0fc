"""Attacks: how theta is searched; the objective arrives as a callable."""
