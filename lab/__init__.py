"""What a calibration is: capture, keep, fit, validate, diagnose, report."""
