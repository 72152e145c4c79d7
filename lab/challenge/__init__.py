"""The challenge: a blind test of the diagnosis on recordings whose concealed effects are sealed until it has answered.

The recordings are made by a second image former (`mocks.former`), which shares no code with `sim`, by which the
diagnosis predicts."""
