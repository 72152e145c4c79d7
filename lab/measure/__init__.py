"""Summaries of captures that fit, validation and diagnosis share: each kind of capture is measured by one code.

Frames are read once by whoever asks first (`RecordingSet.frame`); a summary holds values, their uncertainty, and the captures it is of.
"""
