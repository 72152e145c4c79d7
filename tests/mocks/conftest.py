"""Talking to a grammar without a line: bytes in, everything it says until it is idle out."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from mocks.wire import Grammar

Talk = Callable[[Grammar, bytes], bytes]


@pytest.fixture(scope="session")
def talk() -> Talk:
    def talk_to(grammar: Grammar, data: bytes) -> bytes:
        said = b"".join(grammar.receive(data))
        for _ in range(10_000):
            wait_s = grammar.wait_s
            if wait_s is None:
                return said
            grammar.clock.sleep(wait_s)
            said += b"".join(grammar.elapse())
        raise AssertionError(f"{type(grammar).__name__} never comes to rest")

    return talk_to
