"""The street of a few cars that the product's tests have too."""

from tests.drivesem.conftest import street

__all__ = ["street"]
