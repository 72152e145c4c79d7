"""Two classes never share a name, in whatever package they stand, whether public or private."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_two_classes_never_share_a_name() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for package in ("sim", "drivers", "mocks", "lab", "api", "evaluation/independent_simulator"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef):
                    found[node.name].append(str(path.relative_to(ROOT)))
    assert len(found) > 400
    shared = {name: files for name, files in found.items() if len(files) > 1}
    # the evidence engine stands beside the one that it replaces, and takes over its nouns
    both = {name for name, files in shared.items() if {Path(f).parts[1] for f in files} == {"diagnose", "inference"}}
    assert {name: files for name, files in shared.items() if name not in both} == {}
