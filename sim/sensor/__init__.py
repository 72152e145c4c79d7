"""The sensor: mosaic, electrons, noise, conversion to DN."""
