"""Slanted edges: where they lie, their spread function, and their transfer function."""
