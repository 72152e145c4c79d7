"""Capturing: the station and its instruments, sequences, sessions, and the store that keeps what was captured."""
