"""`drivesem view`: a page on this machine alone: a scene changes as one moves it, and the detector answers."""
