"""Explains failures by parameters and objects, and finds the smallest change that suffices."""
