"""What the diagnosis measures, one file a kind of measurement."""
