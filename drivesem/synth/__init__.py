"""The scene generator: streets, their photographs and exact ground truth from a seed."""
