"""Healthy cameras with less metadata or fewer recordings: what can't be judged is skipped, and nothing is found."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.diagnose import diagnose
from lab.diagnose.inference.decide import decide
from lab.diagnose.inference.side_model import measurement_model
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset


@cache
def _whole(seed: int = 4242) -> RecordingSet:
    return recordings_of(ConcealedCamera(seed, rows=96, cols=128), Plan())


Change = Callable[[dict[str, Any]], None]


def _changed(change: Change, shift: int = 0, seed: int = 4242) -> RecordingSet:
    whole = _whole(seed)
    content = whole.manifest.model_dump(mode="json")
    change(content)
    manifest = Manifest.model_validate(content)
    paths = {getattr(c, key, None) for c in whole.manifest.captures for key in ("radiance", "light_radiance")}
    paths |= {c.screen.radiance for c in whole.manifest.captures if hasattr(c, "screen")}
    paths |= set((manifest.cameras["left"].quantum_efficiency or {}).values())
    frames = {
        c.frame: whole.frame(c) << shift if shift >= 0 else whole.frame(c) >> -shift for c in whole.manifest.captures
    }
    targets = {c.target: whole.target(c.target) for c in whole.manifest.captures if hasattr(c, "target")}
    spectra = {path: whole.spectrum(path) for path in paths if path}
    return RecordingSet(manifest, frames, spectra, targets, source=whole.source)


def _without(*keys: str) -> Change:
    return lambda content: content["cameras"]["left"].update(dict.fromkeys(keys))


def _only(*kinds: str) -> Change:
    return lambda content: content.update(captures=[c for c in content["captures"] if c["kind"] in kinds])


@pytest.mark.parametrize(
    "change",
    [
        _only("narrowband"),  # neither gain nor dark current is known then
        _only("chart"),
        _only("chart", "slanted_edge"),
        _without("f_number"),
        _without("pixel_pitch_um"),
        _without("fill_factor"),
    ],
    ids=["narrowband", "chart", "chart and edges", "f-number", "pitch", "fill factor"],
)
def test_missing_metadata_are_no_mismatch(change: Change) -> None:
    model, _ = measurement_model(_changed(change), "left", None)
    assert model is not None
    found = decide(model, np.random.default_rng(1), DecisionPolicy())
    assert (found.before, found.named, found.abstained) == ((), (), ())


def test_edges_in_unknown_light_are_not_called_defocus() -> None:
    """A monochrome camera: predicted with equal-energy light its edges scored 52 over a threshold of 17, and were
    called 'defocus'."""

    def unlit(content: dict[str, Any]) -> None:
        _only("dark", "flat", "slanted_edge")(content)
        for capture in content["captures"]:
            capture.pop("light_radiance", None)
            capture.pop("dark_radiance", None)

    model, _ = measurement_model(_changed(unlit, seed=72), "left", None)
    assert model is not None
    assert model.camera.cfa == "MONO"
    found = decide(model, np.random.default_rng(1), DecisionPolicy())
    assert (found.before, found.named, found.abstained) == ((), (), ())


def test_the_gain_is_estimated_from_any_repeated_captures() -> None:
    """By repeats of a chart to a few per cent: thousands of pixels, but pixels of a level aren't quite alike."""
    studies = [
        Dataset(r, "left", camera_model(r, "left", None, maker_curves=True))
        for r in (_whole(), _changed(_only("chart")), _changed(_only("narrowband")))
    ]
    by_flats, by_chart, by_single = (s.noise for s in studies)
    assert by_chart.gain_is_known
    assert by_chart.gain == pytest.approx(by_flats.gain, rel=0.05)
    assert not by_single.gain_is_known


def test_codes_that_were_shifted_are_no_faulty_converter() -> None:
    def shifted(content: dict[str, Any]) -> None:
        _only("dark", "flat")(content)
        camera = content["cameras"]["left"]
        camera.update(
            bit_depth=16, black_level_dn=16 * camera["black_level_dn"], white_level_dn=16 * camera["white_level_dn"]
        )

    model, skipped = measurement_model(_changed(shifted, 4), "left", None)
    assert any("codes lie 16 DN apart, as those of fewer bits that were shifted or scaled" in s.reason for s in skipped)
    assert model is not None
    assert not decide(model, np.random.default_rng(1), DecisionPolicy()).before


def test_codes_too_coarse_for_the_noise_are_no_mismatch() -> None:
    """Eight of twelve bits: dark frames and edges' dark sides are one code or two throughout."""

    def coarse(content: dict[str, Any]) -> None:
        camera = content["cameras"]["left"]
        camera.update(bit_depth=8, black_level_dn=camera["black_level_dn"] / 16, white_level_dn=255.0)
        if camera["conversion_gain_dn_per_e"] is not None:
            camera["conversion_gain_dn_per_e"] /= 16

    model, _ = measurement_model(_changed(coarse, -4), "left", None)
    assert model is not None
    assert {"slanted_edge", "screen", "noise"} <= {b.measurement.name for b in model.blocks}
    found = decide(model, np.random.default_rng(1), DecisionPolicy())
    assert (found.before, found.named, found.abstained) == ((), (), ())


@pytest.mark.parametrize(
    ("key", "factor"), [("f_number", 0.7), pytest.param("pixel_pitch_um", 1.25, marks=pytest.mark.slow)]
)
def test_a_misstated_pitch_or_f_number_is_no_blur(key: str, factor: float) -> None:
    """Edges determine f-number / pitch only: the ratio is right to 3 %, and no aberration is named."""

    def edges(content: dict[str, Any]) -> None:
        _only("dark", "flat", "slanted_edge")(content)
        content["cameras"]["left"][key] *= factor

    result = diagnose(_changed(edges, seed=48))
    assert not result.effects
    camera = _whole(48).manifest.cameras["left"]
    (said,) = {u.check for u in result.unexplained if u.measurement == "slanted_edge"}
    found = re.search(r"f/([0-9.]+) in place of .* pitch were ([0-9.]+) um", said)
    assert found is not None, said
    stated = camera.model_copy(update={key: getattr(camera, key) * factor})
    truth = camera.f_number / camera.pixel_pitch_um
    assert float(found[1]) / stated.pixel_pitch_um == pytest.approx(truth, rel=0.03)
    assert stated.f_number / float(found[2]) == pytest.approx(truth, rel=0.03)
