"""The objects that classifiers are shown: made by code, or read from folders of meshes."""
