"""No two modules import each other, directly or through others, whether at run time or for their types."""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter

import grimp
import pytest

PACKAGES = ("lab", "drivers", "sim", "api", "mocks", "evaluation")
#: Imports that close a circle, left in rooms that are being rebuilt: summaries of noise name the type of the data that
#: they are taken from, and the check of held-out captures that of the problem that it checks.
LEFT = {
    ("lab.observables.noise.figures", "lab.observables.dataset"),
    ("lab.observables.noise.repeatability", "lab.observables.dataset"),
    ("lab.inference.check", "lab.inference.recordings"),
}


def order(imports: dict[str, set[str]]) -> list[str]:
    """Return the modules, each after those that it imports. Raises CycleError where there is a circle."""
    return list(TopologicalSorter(imports).static_order())


def test_a_circle_is_noticed() -> None:
    assert order({"a": {"b"}, "b": {"c"}}) == ["c", "b", "a"]
    with pytest.raises(CycleError):
        order({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def test_no_modules_import_each_other() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {
        module: {
            other
            for other in graph.find_modules_directly_imported_by(module)
            if other != module and (module, other) not in LEFT  # a process of its own may start its module anew
        }
        for module in graph.modules
    }
    assert len(imports) > 500
    order(imports)
