"""What a calibration captures: frozen specifications, one per kind of measurement, and the steps that they come to."""
