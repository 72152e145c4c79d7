"""Predictions by a camera model: baseline models, replayed and simulated frames, traced lenses, validation."""
