"""Attacks on a whole clip, with one consistent change per vehicle: `drivesem drive`."""
