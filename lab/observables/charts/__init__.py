"""Charts of coloured patches."""
