"""Concealed proof: sealed recordings with hidden truths, and the score of a diagnosis that hasn't seen them.

The recordings are made by a second image former beside the tests, which only a checkout of the project has.
"""
