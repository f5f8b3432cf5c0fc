"""Maps failure regions around certain failures."""
