"""Detectors that were trained elsewhere, behind `detectors.base.Predictor`; each loads its library where used."""
