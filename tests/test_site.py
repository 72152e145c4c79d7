"""The documentation as a site: every link of every page leads somewhere, and the reference has every public name."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import calibench
from tests import peers

ROOT = Path(__file__).parents[1]


@pytest.mark.extra
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Sphinx warns of each link, heading and formula that it can't resolve."""
    if not all(map(find_spec, ("sphinx", "myst_parser", "furo"))):
        peers.missing("Sphinx isn't installed; `make peers` installs it")
    site = tmp_path / "site"
    line = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", str(ROOT / "docs"), str(ROOT), str(site)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=240, check=False)
    assert (done.returncode, done.stderr) == (0, "")

    reference = (site / "docs/reference/python.html").read_text(encoding="utf-8")
    assert set(re.findall(r'id="calibench\.(\w+)"', reference)) == set(calibench.__all__)
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    searched = json.loads(index[index.index("{") : index.rindex("}") + 1])["docnames"]
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    assert {str(page.relative_to(ROOT).with_suffix("")) for page in pages} <= set(searched)
    assert (site / "index.html").is_file()
