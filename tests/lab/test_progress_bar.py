"""The bar of work that is started from Python."""

from __future__ import annotations

import pytest

from lab.progress_bar import progress_bar


def test_a_bar_writes_each_standing_once(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar(True) as advance:
        advance("fit", 0.5)
        advance("fit", 0.5001)
        advance("fit", 1.5)
    said = capsys.readouterr().err
    assert said.count("fit  50%") == 1 and said.count("fit 100%") == 1


def test_nobody_watches_a_pipe(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar() as advance:
        advance("fit", 0.5)
    assert capsys.readouterr().err == ""
