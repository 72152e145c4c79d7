"""Patterns on a screen: registration, contrast of cells, and the blur of a random pattern."""
