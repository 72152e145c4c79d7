"""Physical effects that a first model leaves out, one file each."""
