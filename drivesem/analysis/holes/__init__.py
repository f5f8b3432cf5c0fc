"""How large the holes of a detector are, of which a run's certain failures are points."""
