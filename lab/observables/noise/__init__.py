"""Temporal and spatial noise of repeats: by level, line, pixel and neighbour; repeats over time."""
