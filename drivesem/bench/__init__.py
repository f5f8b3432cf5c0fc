"""Benchmarks as commands: the same scenes, methods and machines' facts for every figure in the documentation."""
