"""Other programs and libraries that tests need: a browser, a maker's library, a mock of a camera."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def missing(reason: str) -> NoReturn:
    """Skip the test if the program isn't there; in CI, which installs all of them, fail."""
    if os.environ.get("CI"):
        pytest.fail(f"in CI there has to be one: {reason}")
    pytest.skip(reason)
