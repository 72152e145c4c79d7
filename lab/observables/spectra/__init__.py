"""Narrowband light against the sensitivity of the channels."""
