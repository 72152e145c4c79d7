"""Examples of the public interface: those of the docstrings, of the page, and the notebooks. All run."""

from __future__ import annotations

import doctest
import importlib.util
import inspect
import json
import re
from pathlib import Path
from shutil import copytree

import pytest

import calibench
from tests.peers import missing

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "use-from-python.md"
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
#: Examples without a fit, a diagnosis or a process of their own.
QUICK = {
    "certify",
    "charts_of",
    "connect",
    "default_camera",
    "edge_mtf",
    "estimate_kernel",
    "estimate_sensitivity",
    "open_recordings",
    "open_seal",
    "plot",
    "read",
    "read_camera",
    "simulate",
    "write",
    "write_camera",
    "write_certificate",
    "write_frame",
}


def documented() -> list[str]:
    """Names of the interface whose docstring has an example."""
    names = [name for name in calibench.__all__ if inspect.isfunction(getattr(calibench, name))]
    return [name for name in names if ">>> import calibench" in (inspect.getdoc(getattr(calibench, name)) or "")]


@pytest.fixture
def desk(my_camera: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder that has `my-camera`, with nothing of this computer's environment."""
    for name in ("CALIBENCH_DATA", "CALIBENCH_KEY", "CALIBENCH_DATABASE_URL"):
        monkeypatch.delenv(name, raising=False)
    copytree(my_camera, tmp_path / "my-camera")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.extra) for name in documented()]
)
def test_an_example_of_a_docstring(name: str, desk: Path) -> None:
    function = getattr(calibench, name)
    (found,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    assert found.examples
    said: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(found, out=said.append)
    assert result.failed == 0, "".join(said)


def needs(*packages: str) -> None:
    """Skip where a package isn't there."""
    for name in packages:
        if importlib.util.find_spec(name) is None:
            missing(f"{name} isn't installed; `make peers` installs it")


@pytest.mark.extra
def test_the_page_runs_from_its_beginning_to_its_end(desk: Path) -> None:
    needs("pandas", "plotly")
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert len(blocks) > 5
    exec("\n".join(blocks), {})  # a page of this project
    assert (desk / "report.html").is_file() and (desk / "mtf.svg").is_file() and (desk / "edge.dng").is_file()


def test_the_page_names_what_the_interface_has() -> None:
    named = set(re.findall(r"calibench\.([a-z_]+)\(", PAGE.read_text()))
    assert named <= set(calibench.__all__) and len(named) > 15


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_calls_the_interface_alone(notebook: Path) -> None:
    cells = json.loads(notebook.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert set(re.findall(r"calibench\.([A-Za-z_]+)", code)) <= set(calibench.__all__)
    assert not re.search(r"^\s*(?:import|from) (?:lab|sim|api|drivers|mocks|evaluation)\b", code, re.MULTILINE)
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells)


@pytest.mark.extra
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("nbclient", "ipykernel", "pandas", "plotly")
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    read = nbformat.read(notebook, as_version=4)
    NotebookClient(read, timeout=280, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.get("data", {}) for cell in read.cells for output in cell.get("outputs", ())]
    assert sum("text/html" in data for data in shown) >= 1  # results show themselves
