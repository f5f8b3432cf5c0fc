"""Whether what fails one detector fails another: runs of `drivesem attack` before detectors that had no part in them."""
