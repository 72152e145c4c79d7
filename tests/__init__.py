"""Tests, as a package: one that a dependency installs under the same name must not take its place."""
