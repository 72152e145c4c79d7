"""The wheel: what an installation away from the checkout has."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.extra  # builds and installs the wheel

CHECKOUT = Path(__file__).parents[2]
PACKAGES = ("api", "calibench", "drivers", "lab", "mocks", "sim")


@pytest.fixture(scope="module")
def wheel() -> Iterator[Path]:
    """As `pip wheel .` builds it, in a copy, so that nothing is left in the checkout. pip fetches the backend."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "source"
        copy.mkdir()
        for name in (*PACKAGES, "pyproject.toml", "README.md", "LICENSE"):
            (copy / name).symlink_to(CHECKOUT / name)
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, str(copy)]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
        if (
            built.returncode
            and "No matching distribution found for setuptools" in built.stderr
            and "CI" not in os.environ
        ):
            pytest.skip("no package index to fetch the build backend from")
        assert built.returncode == 0, built.stderr[-2000:]
        yield next(Path(folder).glob("*.whl"))


def test_it_has_every_file_of_the_packages(wheel: Path) -> None:
    asked = ["git", "ls-files", "--", *PACKAGES]
    kept = subprocess.run(asked, cwd=CHECKOUT, capture_output=True, text=True, check=True).stdout.split()
    assert len(kept) > 400
    assert set(kept) - set(zipfile.ZipFile(wheel).namelist()) == set()


def test_it_runs_away_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    """The bench and its session, on the wheel's modules alone: libraries are this environment's."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    paths = [str(tmp_path / "installed"), sysconfig.get_path("purelib")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "calibench", "capture", "--quick", "--only", "dark", "--out", "data"]
    code = "import calibench, api, drivers, lab, mocks, sim; print(calibench.__file__, lab.__file__, sim.__file__)"
    where = [sys.executable, "-c", code]
    found = subprocess.run(where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
    assert all(one.startswith(str(tmp_path)) for one in found.split()), found
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "session: " in done.stdout, done.stderr
