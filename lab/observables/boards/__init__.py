"""Calibration boards: corners, camera geometry, and pairs of cameras."""
