"""One file a revision of the registry."""
