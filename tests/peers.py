"""Other programs and libraries that tests need: a browser, a maker's library, a mock of a camera."""

from __future__ import annotations

import importlib.util
import os
import shutil
from typing import NoReturn

import pytest


def browser_program() -> str:
    """Return the program of the browser that the tests drive; the driver is a package of its own."""
    if importlib.util.find_spec("playwright") is None:
        missing("playwright isn't installed; `make peers` installs it")
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if found := shutil.which(name):
            return found
    missing("no Chromium; `make chromium` installs it")


def missing(reason: str) -> NoReturn:
    """Skip the test if the program isn't there; in CI, which installs all of them, fail."""
    if os.environ.get("CI"):
        pytest.fail(f"in CI there has to be one: {reason}")
    pytest.skip(reason)
