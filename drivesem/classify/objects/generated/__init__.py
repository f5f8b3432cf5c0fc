"""Generators of objects of twelve classes; each generator draws proportions and colours at random."""
