"""A change of cars over a whole clip: `drivesem drive`."""
