"""Training of the default network on simulated calibration patterns: `python -m reconstruction.training`."""
