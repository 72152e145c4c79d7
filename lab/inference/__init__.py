"""Inference: one generative model of what was measured, the hypotheses of what acts, and their probabilities.

model.py        y, S, m, J, H: the Gaussian, and the marginal likelihood of the scales of unlisted physics
hypotheses.py   effects, metadata errors, laws of a toy: one type, one prior each; the prior of sets
laplace.py      the evidence about a mode: bounds, heavy-tailed priors, parameters that vanish
discrepancy.py  groups of small physics on states of the chain, with their everyday scales
search.py       closed form, refits: the table of sets
delta.py        the posterior of small physics, as curves
posterior.py    the table -> inclusion probabilities, families, sizes, verdict
check.py        the held-out predictive check
recordings.py   all of it on one side of a recording set

docs/explanation/evidence.md states it symbol by symbol. It stands beside `lab.diagnose` until it replaces it.
"""
