"""Vehicle meshes: generated templates, import from files, levels of detail."""
