"""Calibration: relative answers read as evidence of what changed in the world."""
