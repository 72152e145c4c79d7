"""Only `sim` applies an effect's physics: other code asks the three entries `sim.uniform`, `sim.point` and
`sim.frame`.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from sim.effects.base import STAGES, Effect
from sim.effects.library import effects

ROOT = Path(__file__).parents[2]
OUTSIDE = sorted(p for room in ("lab", "api", "drivers", "mocks") for p in (ROOT / room).rglob("*.py"))
#: A hidden camera of the bench may have laws of its own: it writes stage methods, and doesn't apply them.
WRITES_LAWS = {ROOT / "mocks" / "truth.py"}


def _stage_methods_used(tree: ast.AST) -> list[str]:
    return [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr in STAGES.values()]


def _imported(tree: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {node.module} | {f"{node.module}.{name.name}" for name in node.names}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found


def test_the_walk_sees_a_stage_method() -> None:
    assert _stage_methods_used(ast.parse("effect.on_image(image).otf(fx, fy, 550.0)")) == ["on_image"]
    assert "sim.stages.image_of" in _imported(ast.parse("from sim.stages import image_of"))


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_code_outside_sim_applies_an_effect(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if path in WRITES_LAWS:
        return
    assert not _stage_methods_used(tree), "ask sim.uniform, sim.point or sim.frame"
    reached = {name for name in _imported(tree) if name.startswith(("sim.stages", "sim.detection", "sim.plain_image"))}
    assert not reached, "inner rooms of sim: ask its entries"


def test_an_effect_has_at_most_eight_methods_to_write() -> None:
    """The stage methods, the two that a score asks, and what hardware bounds; none of the library's effects overrides
    anything else of the base.
    """
    writable = {*STAGES.values(), "prototypes", "log_prior", "limits"}
    assert len(writable) <= 8
    own = {name for name in vars(Effect) if not name.startswith("_") and callable(getattr(Effect, name))}
    for kind in effects().values():
        overridden = {
            name for base in kind.__mro__ if base is not Effect and issubclass(base, Effect) for name in vars(base)
        }
        assert overridden & own <= writable, kind.name
