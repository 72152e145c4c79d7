"""Flats: level against light, temporal noise against level, shading, rows, and the ratio of the greens."""
