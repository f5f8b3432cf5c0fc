"""Readers and writers of data sets, and what their class names mean."""
