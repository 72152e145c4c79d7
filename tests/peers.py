"""Programs and libraries of others that tests need: a browser, a maker's library, a camera's stand-in."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def missing(reason: str) -> NoReturn:
    """What to do where one isn't there: on a desk the test is skipped, in CI, which installs all of them, it fails."""
    if os.environ.get("CI"):
        pytest.fail(f"in CI there has to be one: {reason}")
    pytest.skip(reason)
