"""Detectors trained elsewhere as `detectors.base.Predictor` or `Detector`; libraries are imported when used."""
