"""Observables: what captures say in numbers, with their covariance, and what the chain of light predicts of them.

observable.py  the declaration, the numbers with labels and covariance, their prediction; the list of all
dataset.py     one side of a recording set: frames summarised once
darks/ flats/ noise/ codes/ spectra/ charts/ edges/ screens/ boards/   one folder a kind, one file a summary

It knows neither fits nor the diagnosis, which are questions to it.
"""
