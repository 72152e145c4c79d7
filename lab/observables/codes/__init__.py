"""Codes of the converter: their step, rounding, and the histogram of codes in uniform light."""
