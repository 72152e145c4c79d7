"""docs/write-a-driver.md and docs/test-a-driver.md as they stand: their files make a package whose tests, the contract
among them, pass."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
WRITTEN = re.compile(r"[Ww]rite `([\w.]+)`:\n\n```\w*\n(.*?)```\n", re.DOTALL)


def test_the_package_of_the_page_works(tmp_path: Path) -> None:
    pages = (ROOT / "docs" / name for name in ("write-a-driver.md", "test-a-driver.md"))
    files = {name: text for page in pages for name, text in WRITTEN.findall(page.read_text(encoding="utf-8"))}
    assert set(files) == {
        *("cs2000.py", "cs2000.txt", "mock_cs2000.py", "pyproject.toml", "contract.toml", "test_cs2000.py"),
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    # What `pip install -e` would write, without the network.
    installed = tmp_path / "calibench_cs2000-0.1.0.dist-info"
    installed.mkdir()
    project = tomllib.loads(files["pyproject.toml"])["project"]
    (installed / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = (
        f"[{group}]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())
        for group, entries in project["entry-points"].items()
    )
    (installed / "entry_points.txt").write_text("\n\n".join(points) + "\n")
    run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", "test_cs2000.py"]
    paths = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        run,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "3 passed" in done.stdout
