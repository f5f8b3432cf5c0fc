"""How real changed pictures look, and how much they teach: distances, information worth, and what people say."""
