"""What a camera model says of a capture: baseline models, replayed and simulated frames, validation."""
