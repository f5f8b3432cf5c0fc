"""Whether what fails one detector fails another: runs of `drivesem attack` shown to other detectors."""
