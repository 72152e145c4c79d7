"""From measurements to probabilities: evidence, score, search, refit, decision."""
