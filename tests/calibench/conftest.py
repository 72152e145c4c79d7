"""One folder of raw frames for all tests of the public interface, and its fit."""

from __future__ import annotations

from pathlib import Path

import pytest

import calibench
from tests.calibench.my_camera import make_folder


@pytest.fixture(scope="session")
def my_camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_folder(tmp_path_factory.mktemp("frames") / "my-camera")


@pytest.fixture(scope="session")
def recordings(my_camera: Path) -> calibench.RecordingSet:
    return calibench.open_recordings(my_camera)


@pytest.fixture(scope="session")
def fit(recordings: calibench.RecordingSet) -> calibench.FitResult:
    return calibench.fit(recordings, progress=False)
