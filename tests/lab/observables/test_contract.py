"""The contract of every declared observable: unbiased, its covariance true, its numbers free of statements.

Held against drawn frames of the independent simulator, of a rig that is wrong within its tolerances: what the camera
model predicts, through the same estimator, is the mean of the numbers of drawn frames. Kinds whose estimators know a
mosaic, a size or a depth have contracts of their own beside this one (edges, screens, boards).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law
from scipy.stats import norm

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.observables import scatter
from evaluation.rig_errors import RigErrors
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.side_model import measurement_model
from lab.fit import fit_recording_set
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.observable import Observable, measurements

Layout = tuple[str, int, int, int]  # mosaic, rows, columns, bits
KINDS = ("dark", "flat", "narrowband", "chart", "slanted_edge", "screen")
EVERYDAY: tuple[Layout, ...] = (("RGGB", 96, 128, 12), ("MONO", 64, 96, 10))
MORE: tuple[Layout, ...] = (
    ("BGGR", 96, 128, 12), ("GRBG", 64, 96, 14), ("GBRG", 48, 64, 8), ("RGGB", 192, 256, 10), ("GBRG", 192, 256, 12),
    ("MONO", 192, 256, 14), ("BGGR", 48, 64, 16), ("MONO", 48, 64, 8),
)  # fmt: skip
LAYOUTS = [*EVERYDAY, *(pytest.param(one, marks=pytest.mark.extra) for one in MORE)]
#: Probability by chance that a test fails: that of three standard deviations, shared by the observables of a set.
CHANCE = 2.0 * float(norm.sf(3.0)) / len(measurements())
#: Observables whose covariance is known to be too wide, and why. A lower bound of chi2 is no test of theirs.
WIDE = {
    "black_level": "the prior of the stated level",
    "noise_tones": "no tone is expected, and a threshold has no scatter",
    "defective_pixels": "of counts of which none is expected",
    "flickering_pixels": "of counts of which none is expected",
    "dark_events": "of counts of which none is expected",
    "bernoulli": "the floor of the drawing",
    "lateral_colour": "the floor of cells that stand square",
}


@cache
def recorded(layout: Layout) -> RecordingSet:
    """Return the session of a healthy camera. Its seed is the layout's."""
    cfa, rows, cols, bits = layout
    seed = sum(layout[1:])
    rig = RigErrors(seed)
    plan = Plan(KINDS, shuttle=True, chart=rig.reflectances, reading=rig.reading)
    return recordings_of(ConcealedCamera(seed, cfa=cfa, rows=rows, cols=cols, bit_depth=bits), plan)


@cache
def model_of(layout: Layout) -> MeasurementModel:
    return measured(recorded(layout))


def measured(recordings: RecordingSet) -> MeasurementModel:
    model, _ = measurement_model(recordings, "left", fit_recording_set(recordings))
    assert model is not None
    return model


@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_numbers_scatter_about_their_prediction_as_their_covariance_says(layout: Layout) -> None:
    """chi2 of n numbers, and the mean of their pulls, within three standard deviations (of all observables of a set
    together, by Bonferroni)."""
    wrong = {}
    for one in scatter(model_of(layout)):
        if one.observable == "all" or one.n == 0:
            continue
        high, low = chi2_law.isf([CHANCE / 2.0, 1.0 - CHANCE / 2.0], one.n)
        if one.chi2 > high or (one.chi2 < low and one.observable not in WIDE) or abs(one.pull) > norm.isf(CHANCE / 2.0):
            wrong[one.observable] = one
    assert not wrong


def test_every_observable_is_declared_once_and_the_list_of_wide_ones_names_them() -> None:
    names = [one.name for one in measurements()]
    assert len(names) == len(set(names))
    assert set(WIDE) <= set(names)


# --- No statement enters a number -------------------------------------------------------------------------------------


def restated(
    recordings: RecordingSet, of_camera: dict[str, Any], of_captures: dict[str, Callable[[Any], Any]]
) -> RecordingSet:
    """Return the same frames with other statements on the camera, and on all captures that state them."""
    document = recordings.manifest.model_dump(mode="json", exclude_none=True)
    document["cameras"]["left"] |= of_camera
    for capture in document["captures"]:
        for key, change in of_captures.items():
            if key in capture:
                capture[key] = change(capture[key])
    return recordings.under(Manifest.model_validate(document))


def changed(one: RecordingSet, other: MeasurementModel, equal: Callable[[Observable, Observable], bool]) -> set[str]:
    """Return the names of the observables whose numbers differ."""
    before = {block.measurement.name: block for block in other.blocks}
    after = {block.measurement.name: block for block in measured(one).blocks}
    return {name for name in before if name not in after or not equal(before[name], after[name])}


@pytest.mark.parametrize("layout", EVERYDAY, ids=str)
@pytest.mark.parametrize(
    ("of_camera", "of_captures"),
    [
        ({"black_level_dn": 0.0}, {}),
        ({"f_number": 8.0}, {}),
        ({"pixel_pitch_um": 9.0, "fill_factor": 0.3}, {}),
        # a power of two: times and rates are rounded alike
        pytest.param({}, {"exposure_s": lambda value: 16.0 * value}, marks=pytest.mark.extra),
        pytest.param({}, {"id": lambda value: f"z{value}"}, marks=pytest.mark.extra),
    ],
    ids=["black level", "f-number", "pitch", "exposure", "label"],
)
def test_numbers_are_equal_bit_for_bit_under_other_statements(
    layout: Layout, of_camera: dict[str, Any], of_captures: dict[str, Callable[[Any], Any]]
) -> None:
    def equal(one: Observable, other: Observable) -> bool:
        return np.array_equal(one.value, other.value)

    assert not changed(restated(recorded(layout), of_camera, of_captures), model_of(layout), equal)


#: Observables that average the greens before anything is measured: with greens stated where red and blue are, their
#: numbers are others. A summary by plane of the 2 x 2 cell would leave this list.
BY_CHANNEL = {
    "bernoulli", "cell_borders", "chart", "flat_field", "ghost", "green_balance", "lateral_colour", "narrowband",
    "noise", "noise_skewness", "photon_transfer", "screen", "screen_grid", "slanted_edge",
}  # fmt: skip


@pytest.mark.parametrize(
    ("cfa", "others"),
    [("BGGR", {"green_balance", "screen", "screen_grid"}), pytest.param("GRBG", BY_CHANNEL, marks=pytest.mark.extra)],
)
def test_numbers_of_planes_are_those_of_another_mosaic(cfa: str, others: set[str]) -> None:
    """But for their order, and for the order of sums: 1e-9 of a standard deviation."""

    def equal(one: Observable, other: Observable) -> bool:
        if one.value.shape != other.value.shape:
            return False
        apart = np.sort(one.value) - np.sort(other.value)
        return bool(np.all(np.abs(apart) < 1e-9 * np.sqrt(np.diag(one.covariance)).max()))

    assert changed(restated(recorded(EVERYDAY[0]), {"cfa": cfa}, {}), model_of(EVERYDAY[0]), equal) == others
