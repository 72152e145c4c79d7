"""Summaries of the masked pixels and the overscan of dark frames and flats."""
