"""Order of the whole suite's tests."""

from __future__ import annotations

import signal

import pytest
from hypothesis import HealthCheck, settings

# No test states a time: a busy machine's pause of a second is no fault of what is tested.
settings.register_profile("any machine", settings.default, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

# Whoever starts the suite in the background may have it ignore Ctrl-C, and with it the commands that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run tests with a stated time limit first: a long one at the end would keep the other worker waiting."""
    items.sort(key=lambda item: item.get_closest_marker("timeout") is None)
