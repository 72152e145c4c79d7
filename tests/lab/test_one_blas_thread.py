"""The numerics have one thread for linear algebra, whoever calls them; afterwards the process has its own number
again."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from lab.measure import edge_mtf
from lab.one_blas_thread import one_blas_thread
from tests.lab.measure.drawn_edges import edge


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in ThreadpoolController().info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    """The default of a user's environment: BLAS with two threads."""
    with threadpool_limits(2, user_api="blas"):
        for library in (
            ThreadpoolController().select(internal_api="openblas").lib_controllers
        ):  # as if no thread had set it
            library.clear_controlling_thread(force=True)
        if blas_threads() != {2}:
            pytest.skip("this BLAS has no second thread")
        yield


def test_inside_there_is_one_and_outside_what_there_was():
    @one_blas_thread
    def inner() -> set[int]:
        return blas_threads()

    @one_blas_thread
    def outer() -> tuple[set[int], set[int]]:
        return inner(), blas_threads()

    assert outer() == ({1}, {1})
    assert blas_threads() == {2}


def test_a_failure_gives_the_threads_back():
    @one_blas_thread
    def fails() -> None:
        raise ValueError

    with pytest.raises(ValueError):
        fails()
    assert blas_threads() == {2}


def test_the_last_to_leave_gives_them_back():
    """Two threads that overlap: the first to come leaves first and lives on, and what it set mustn't stay."""
    first_inside, second_inside, first_left, second_left = (threading.Event() for _ in range(4))
    seen: list[set[int]] = []

    @one_blas_thread
    def first() -> None:
        first_inside.set()
        assert second_inside.wait(30.0)

    @one_blas_thread
    def second() -> None:
        second_inside.set()
        assert first_left.wait(30.0)
        seen.append(blas_threads())

    def first_and_later() -> None:
        first()
        first_left.set()
        assert second_left.wait(30.0)

    one, two = threading.Thread(target=first_and_later), threading.Thread(target=second)
    one.start()
    assert first_inside.wait(30.0)
    two.start()
    two.join(30.0)
    left = blas_threads()
    second_left.set()
    one.join(30.0)
    assert (seen, left) == ([{1}], {2})


def test_an_edge_is_measured_with_one(monkeypatch: pytest.MonkeyPatch):
    seen: list[set[int]] = []
    measured = edge_mtf.measure_mtf
    monkeypatch.setattr(
        edge_mtf, "measure_mtf", lambda *arguments: (seen.append(blas_threads()), measured(*arguments))[1]
    )
    edge_mtf.edge_mtf(np.asarray(edge(64, 5.0, 0.5)))
    assert seen == [{1}]
