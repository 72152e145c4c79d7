"""Predictions before the capture: of a session in a configuration that nobody has seen, sealed, and opened against its
recordings."""
