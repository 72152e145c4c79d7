"""The documentation names what exists: links, headings, files, Python names; and nothing of one computer."""

from __future__ import annotations

import importlib
import re
import runpy
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("sim", "drivers", "mocks", "lab", "api", "evaluation", "tests", "docs", "benchmarks")
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
SOURCES = sorted(
    [
        ROOT / "Makefile",
        *(p for room in (*ROOMS, "calibench") for p in (ROOT / room).rglob("*.py") if p != Path(__file__).resolve()),
    ]
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
CODE = re.compile(r"`([^`\n]+)`")
FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
#: A page may name a file that it tells its reader to write, or that a command of it writes.
WRITTEN = re.compile(r"(?:\b[Ww]rite\w* `|--out )([^`\s]+)")
FILE = re.compile(rf"(?:{'|'.join(ROOMS)})/[\w*./-]*\w/?")
PYTHON_FILE = re.compile(r"[\w/]+\.py")
PYTHON_NAME = re.compile(rf"(?:{'|'.join(ROOMS[:6])})(?:\.[A-Za-z]\w*)+")
LONGEST = 200
#: Pages that `docs/write_tables.py`, `make proof`, `make proof-live` and `make real` write.
GENERATED = (
    "docs/explanation/diagnosis.md",  # by hand; it is rewritten with the engine
    "docs/proof.md",
    "docs/real-recordings.md",
    "docs/reference/command-line.md",
    "docs/reference/effects.md",
    "docs/reference/standards.md",
)
#: Folders that are made on use.
MADE = ("calibench-data",)

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@cache
def headings(page: Path) -> frozenset[str]:
    """Anchors of a page, as GitHub forms them."""
    found = re.findall(r"^#+ +(.+)$", FENCE.sub("", text_of(page)), re.MULTILINE)
    return frozenset(re.sub(r"[^\w\- ]", "", title.strip().lower()).replace(" ", "-") for title in found)


def exists(path: str) -> bool:
    return any(ROOT.glob(path.rstrip("/"))) if "*" in path else (ROOT / path).exists()


def files_named(text: str) -> set[str]:
    """Paths that start with a room of the project, and names of Python files."""
    found = set()
    for token in re.split(r"[\s,;:()\[\]\"'`=]+", text):
        if FILE.fullmatch(token) or PYTHON_FILE.fullmatch(token):
            found.add(token)
    return found


def missing_files(text: str) -> list[str]:
    """What `text` names and the project doesn't have; a bare file name has to be some file's."""
    missing = []
    for name in files_named(text):
        bare = name.split("/")[0] not in ROOMS
        if not (any(ROOT.glob(f"[!.]*/**/{name}")) if bare else exists(name)):
            missing.append(name)
    return sorted(missing)


def test_a_missing_file_is_noticed() -> None:
    assert missing_files("see sim/effects/none_such.py:12 and nowhere.py, not sim/effects/coma.py or coma.py") == [
        "nowhere.py",
        "sim/effects/none_such.py",
    ]


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(FENCE.sub("", text_of(page))):
        if "://" in link:
            continue
        path, _, heading = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if heading:
            assert heading in headings(target), link


@each_page
def test_files_exist(page: Path) -> None:
    text = text_of(page)
    named = "\n".join(CODE.findall(FENCE.sub("", text))) + "\n" + "\n".join(FENCE.findall(text))
    assert set(missing_files(named)) <= set(WRITTEN.findall(text))


@each_page
def test_python_names_exist(page: Path) -> None:
    for code in CODE.findall(FENCE.sub("", text_of(page))):
        for name in PYTHON_NAME.findall(code):
            if name.split(".")[-1] in {"py", "md", "toml", "json", "example"}:
                continue
            module, rest = name, ""
            while True:
                try:
                    found = importlib.import_module(module)
                    break
                except ModuleNotFoundError:
                    module, _, last = module.rpartition(".")
                    rest = f"{last}.{rest}".strip(".")
                    assert module, name
            for part in rest.split(".") if rest else []:
                assert hasattr(found, part) or part in getattr(found, "model_fields", {}), name
                found = getattr(found, part, None)


#: Top folders in which one computer keeps its own files, a folder beside the checkout, and a registry's host.
ONE_COMPUTERS = (*(f"/{folder}/" for folder in ("work", "home", "tmp")), "../shared", "pypi")


@each_page
def test_nothing_of_one_computer(page: Path) -> None:
    text = text_of(page)
    for unwanted in ONE_COMPUTERS:
        assert unwanted not in text, unwanted


@pytest.mark.parametrize("page", [p for p in PAGES if p.parent != ROOT], ids=lambda p: str(p.relative_to(ROOT)))
def test_every_page_can_be_reached(page: Path) -> None:
    """Some other page links to it."""
    linked = {
        (other.parent / link.partition("#")[0]).resolve()
        for other in PAGES
        if other != page
        for link in LINK.findall(FENCE.sub("", text_of(other)))
        if "://" not in link
    }
    assert page in linked or page.parent in linked


@each_page
def test_a_page_answers_one_question(page: Path) -> None:
    """Pages of more than LONGEST lines are split, but those that a program writes."""
    lines = len(text_of(page).splitlines())
    assert lines <= LONGEST or str(page.relative_to(ROOT)) in GENERATED, f"{lines} lines; split the page by question"


@pytest.mark.parametrize("page", ["effects", "command-line"])
def test_generated_pages_are_current(page: str) -> None:
    """Else: `python docs/write_tables.py PAGE`."""
    pages = runpy.run_path(str(ROOT / "docs" / "write_tables.py"))["PAGES"]
    assert (ROOT / "docs" / "reference" / f"{page}.md").read_text(encoding="utf-8") == pages[page]()


def test_pages_that_the_code_names_exist() -> None:
    missing = {
        f"{source.relative_to(ROOT)}: {page}"
        for source in SOURCES
        for page in re.findall(r"\bdocs/[\w/-]+\.(?:md|py|svg|png|jpg)\b", text_of(source))
        if not exists(page)
    }
    assert not missing
