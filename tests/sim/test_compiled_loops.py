"""A user without a home, on an installation that can't be written, compiles and keeps the loops."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim import compiled_loops
from sim.compiled_loops import choose_cache

#: A package with a compiled loop, beside the module under test.
LOOP = """
from numba import njit
@njit(cache=True)
def double(values):
    return 2.0 * values
"""
#: Becomes a user who may write neither home nor installation, runs the loop, and says where it is kept. What this user
#: may not read of the tests' own environment is loaded before.
RUNS = """
import os, pwd, sys, tempfile
import numpy as np
import numba
numba.njit(lambda x: 2.0 * x)(np.zeros(3))
user = pwd.getpwnam("nobody")
os.setgroups([])
os.setgid(user.pw_gid)
os.setuid(user.pw_uid)
if sys.argv[1:] != ["without"]:
    from installed.compiled_loops import choose_cache
    choose_cache()
from installed.optics.loop import double
double(np.zeros(3))
print(os.environ.get("NUMBA_CACHE_DIR", ""))
"""


def run_as_nobody(installed: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the loop of an installation, as a user who may write neither it nor a home."""
    return subprocess.run(
        [sys.executable, "-c", RUNS, *arguments],
        cwd=installed.parent,
        env={"PATH": os.defpath, "PYTHONPATH": str(installed.parent), "HOME": "/nonexistent", **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def installed() -> Iterator[Path]:
    """An installation where only root may write, in a folder that others may enter: pytest's own is closed to them."""
    with tempfile.TemporaryDirectory(prefix="calibench-installed-") as folder:
        Path(folder).chmod(0o755)
        made = Path(folder) / "installed"
        (made / "optics").mkdir(parents=True)
        shutil.copy(compiled_loops.__file__, made)
        (made / "optics" / "loop.py").write_text(LOOP)
        yield made


@pytest.mark.skipif(os.geteuid() != 0, reason="acts as a user without a home")
def test_a_user_without_a_home_compiles(installed: Path) -> None:
    """In the data folder where there is one of that user, else among the temporary ones, never in another user's."""
    user = pwd.getpwnam("nobody")
    data, temporary = installed.parent / "data", installed.parent / "tmp"
    data.mkdir(mode=0o750)
    os.chown(data, user.pw_uid, user.pw_gid)
    temporary.mkdir()
    temporary.chmod(0o1777)
    assert "cannot cache function" in run_as_nobody(installed, "without", TMPDIR=str(temporary)).stderr
    done = run_as_nobody(installed, CALIBENCH_DATA=str(data), TMPDIR=str(temporary))
    assert (done.returncode, done.stdout.strip()) == (0, str(data / ".numba")), done.stderr
    assert list((data / ".numba").rglob("*.nbc"))
    strange = temporary / f"calibench-numba-{user.pw_uid}"
    strange.mkdir(mode=0o777)  # root's: what is in it could be anything
    done = run_as_nobody(installed, TMPDIR=str(temporary))
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).parent == temporary and Path(done.stdout.strip()) != strange


def test_a_folder_that_was_asked_for_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/of/the/user")
    choose_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "/of/the/user"


def test_an_installation_that_can_be_written_keeps_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    choose_cache()
    assert "NUMBA_CACHE_DIR" not in os.environ
