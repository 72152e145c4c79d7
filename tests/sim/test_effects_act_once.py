"""An effect acts exactly once in a frame, whatever the way in which the frame is computed."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from sim import frame as sim_frame
from sim.camera import CameraModel, Lens
from sim.effects import library
from sim.effects.base import STAGES, Effect
from sim.effects.library import effects
from sim.frame import Exposure
from sim.point import TRANSFER, edge_profile
from sim.scene import (
    EdgeRegion,
    KnifeEdge,
    Scene,
    ScreenPattern,
    Warp,
)
from sim.sensor import electrons as sensor
from sim.spectrum import Spectrum
from sim.stages import charge_of
from sim.uniform import Uniform, electron_rate
from tests.sim.local_effects import scenes


def _two_cells(lamp: Spectrum) -> tuple[Scene, Scene]:
    """An upright edge between columns 47 and 48, as a knife edge and as a drawn screen."""
    dark = lamp.scale(0.02)
    edge = KnifeEdge((EdgeRegion((0, 0, 72, 96), 0.0),), dark, lamp)
    warp = Warp.from_corners(2, 1, [(-1000.0, -952.5), (-1000.0, 1047.5), (1000.0, 1047.5), (1000.0, -952.5)])
    return edge, ScreenPattern(np.array([[0, 1]], np.uint8), warp, dark, lamp, kind="slanted_edge")


def _one_deviation(kind: type[Effect]) -> Effect:
    """The effect at one standard deviation of its first parameter's prior."""
    name, quantity = next(iter(kind.quantities().items()))
    assert quantity.prior is not None
    return kind.from_linear({name: quantity.prior[1] ** quantity.linear_power})


SPREADING = [
    _one_deviation(kind)
    for kind in library.effects().values()
    if TRANSFER & library.may_change(kind)
    # on axis what grows with the field does nothing; a discovered law acts where its table is; packets of few rows, and
    # along an edge, lose nothing (`tests/sim/effects/test_charge_transfer_inefficiency.py` has an edge across columns)
    and kind.name not in {"veiling_glare", "field_curvature", "empirical_law", "charge_transfer_inefficiency"}
]


@pytest.mark.parametrize("one", SPREADING, ids=lambda e: e.name)
def test_a_blur_acts_once_in_a_frame_as_in_an_edges_profile(
    mono_camera: CameraModel, lamp: Spectrum, one: Effect
) -> None:
    """What an effect changes in a MONO frame across an edge is what it changes in the edge's profile, whether the frame
    is drawn or taken from the profile, and whether the effect blurs the image, moves the charge or filters the codes.
    The drawing's own error, and its other end, change by 2 % of what the effect does.
    """
    camera = mono_camera.model_copy(
        update={"dark_current_e_per_s": 0.0, "lens": Lens(f_number=4.0, focal_length_mm=5000.0)}
    )
    distance = np.arange(96.0) - 47.5
    level = 0.98 * electron_rate(camera, "Y", lamp)
    with_it, without = (edge_profile(camera, "Y", lamp, 0.0, distance, acting) for acting in ((one,), ()))
    wanted = with_it - without
    assert np.abs(wanted).max() > 3e-3  # it does act
    processing = Uniform(camera, (one,)).filter_kernel()
    for scene in _two_cells(lamp):
        with_it, without = (
            sim_frame.expected_electrons(camera, Exposure(scene, 1.0), acting, oversample=6) / level
            for acting in ((one,), ())
        )
        with_it = with_it if processing is None else sensor.filter_planes(with_it, processing, camera.cfa)
        np.testing.assert_allclose((with_it - without)[36, 8:-8], wanted[8:-8], atol=0.03 * np.abs(wanted).max())


def test_crosstalk_acts_once_in_a_mosaic(colour_camera: CameraModel, lamp: Spectrum) -> None:
    """A frame with crosstalk is the frame without it, its charge moved between neighbours once: nothing else
    happens.
    """
    kind = library.effects()["crosstalk"](share_percent=4.0)
    for scene in scenes(lamp)[1:]:
        without = sim_frame.expected_electrons(colour_camera, Exposure(scene, 0.02))
        with_it = sim_frame.expected_electrons(colour_camera, Exposure(scene, 0.02), (kind,))
        np.testing.assert_allclose(with_it, charge_of(colour_camera, (kind,)).move_charge(without), rtol=1e-12)
        assert np.abs(with_it - without).max() > 1.0


# ----------------------------------------------------------------------------------------------------------------------
# Only `sim` applies an effect's physics: other code asks the three entries `sim.uniform`, `sim.point` and `sim.frame`.


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
