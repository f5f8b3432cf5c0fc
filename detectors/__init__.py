"""Object detectors behind one contract: see `detectors.base`."""
