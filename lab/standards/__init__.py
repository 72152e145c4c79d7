"""Standards of cameras as they specify their figures: readings of the summaries that fits and diagnosis use."""
