"""Blind proof of the diagnosis: sealed recordings with concealed truths, and the score of what the diagnosis said of them.

A second image former (`mocks.former`) makes the recordings: it shares no code with `sim`, by which the diagnosis predicts.
"""
