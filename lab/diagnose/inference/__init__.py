"""From measurements to names: measurement model, location, scores, search, weighing, naming."""
