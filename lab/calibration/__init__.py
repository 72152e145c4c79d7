"""A calibration's life: candidate, certified, superseded, expired; its figures and their history."""
