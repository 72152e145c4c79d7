"""Summaries of captures that fits and diagnosis share; it knows neither.

So far those of darks and flats: statistics of the levels (`levels`), lines through them (`level_lines`), the light that flats state
(`stated_light`), single pixels in the dark (`dark_pixels`), and captures that aren't what they are said to be (`mishaps`). Edges, screens,
boards and spectra are still measured in `lab.fit` and in `lab.diagnose.measurements`.
"""
