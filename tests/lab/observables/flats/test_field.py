"""Flats over the frame: shading, and signal that is added to the light's."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest

from evaluation.independent_simulator.laws import (
    DustShadowLaw,
    MicrolensAngleLaw,
    NonUniformIlluminationLaw,
    TapGainLaw,
    VignettingDecentreLaw,
    VignettingLaw,
)
from lab.formats.recording_set import RecordingSet
from lab.observables.darks.field import measure_dark_field
from lab.observables.darks.level import measure_dark
from lab.observables.darks.readout import measure_fixed_lines
from lab.observables.dataset import Dataset
from lab.observables.flats.field import (
    ALIKE,
    _adjacent,
    _cell_means,
    _cell_points,
    _cells,
    _channel_points,
    _pattern_variance,
    measure_flat_field,
)
from lab.observables.flats.green_balance import measure_green_balance
from lab.observables.flats.linearity import measure_photon_transfer
from lab.observables.flats.rows import measure_flat_rows
from lab.observables.observable import Observable
from sim.camera import Cfa
from sim.sensor import mosaic
from tests.lab.diagnose.on_blocks import dataset, former, measured_model, names, rendered, sigmas, verdict
from tests.sim.local_effects import ReadOutRamp

LOOKED_AT = (measure_flat_field, measure_photon_transfer)


def test_healthy_cells_scatter_as_they_should() -> None:
    """4 cameras: the mean of chi2's departures within 3 / sqrt(4) of its standard deviations, and 0.5 for the free axis
    and level."""
    found = [sigmas(measured_model(former(s, cfa=c), measure_flat_field)) for s in (1, 2) for c in ("MONO", "BGGR")]
    assert abs(np.mean(found)) < 3.0 / np.sqrt(4) + 0.5
    assert max(found) < 4.0


@pytest.mark.parametrize("variant", [0, *(pytest.param(v, marks=pytest.mark.slow) for v in (1, 2))])
def test_vignetting_is_named_whatever_its_power(variant: int) -> None:
    """As the square of the radius, as the overlap of two discs, as the fourth power."""
    found = verdict(former(21, VignettingLaw(4.0, variant, 1), cfa="RGGB"), *LOOKED_AT)
    assert names(found) == ["vignetting"]
    if variant == 0:
        one = found.named[0]
        std = one.std["corner_loss_percent"]
        assert std is not None
        assert abs(one.effect.model_dump()["corner_loss_percent"] - 4.0) < 3.0 * std


@pytest.mark.parametrize("variant", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_fall_off_about_another_point_is_named(variant: int) -> None:
    found = verdict(former(22, VignettingDecentreLaw(0.3, variant, 2)), *LOOKED_AT)
    assert names(found) == ["vignetting_decentre"]


def test_microlenses_at_another_angle_are_named_and_vignetting_is_not() -> None:
    """By the second image former; each parameter within 4 of its own standard deviations."""
    blocks = (*LOOKED_AT, measure_green_balance)
    law = MicrolensAngleLaw(6.0, 0, 9)
    found = verdict(former(21, law, cfa="RGGB"), *blocks)
    assert names(found) == ["microlens_angle"]
    for name, truth in law.library_parameters().items():
        std = found.named[0].std[name]
        assert std is not None
        assert getattr(found.named[0].effect, name) == pytest.approx(truth, abs=4.0 * std)
    assert names(verdict(former(21, VignettingLaw(4.0, 0, 1), cfa="RGGB"), *blocks)) == ["vignetting"]


@pytest.mark.parametrize("variant", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_slope_is_uneven_light_with_or_without_a_bow(variant: int) -> None:
    truth = NonUniformIlluminationLaw(1.5, variant, 3)
    found = verdict(former(23, truth, cfa="GRBG"), *LOOKED_AT)
    assert names(found) == ["non_uniform_illumination"]
    for name, value in truth.library_parameters().items():
        std = found.named[0].std[name]
        assert std is not None
        assert abs(found.named[0].effect.model_dump()[name] - value) < 3.0 * std


def test_what_no_law_fits_is_seen_and_gets_no_name() -> None:
    found = verdict(former(24, DustShadowLaw(2.0, 0, 4)), *LOOKED_AT)
    assert not found.named
    assert {s.block.measurement.name for s in found.before} == {"flat_field"}


def test_a_brighter_half_is_a_tap() -> None:
    assert names(verdict(former(24, TapGainLaw(1.0)), *LOOKED_AT)) == ["taps"]


def test_a_pattern_that_neighbours_share_counts_more() -> None:
    """White pattern: its own variance, within 3 sqrt(2 / 192) of blocks' differences and the same for the median;
    common pattern: at most ALIKE times as much."""
    rng = np.random.default_rng(3)
    white = 1.0 + 0.01 * rng.standard_normal((192, 256))
    assert _pattern_variance(white, 0.0) == pytest.approx(1e-4, rel=0.2)
    alike = 0.8 * (white - 1.0) + 0.02 * np.kron(rng.standard_normal((48, 64)), np.ones((4, 4)))
    single = _pattern_variance(1.0 + 0.8 * (white - 1.0), 0.0)
    assert single < _pattern_variance(1.0 + alike, 0.0) <= ALIKE * _adjacent(1.0 + alike, 1)


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG", "MONO"])
@pytest.mark.parametrize("shape", [(24, 32), (50, 70)])
def test_cells_are_predicted_where_the_pixels_of_their_channel_stand(cfa: Cfa, shape: tuple[int, int]) -> None:
    """A bowl about the axis, x^2 + y^2 of the pixels' middles: means over pixels `step` apart are less than those over
    the cells' area by step^2 / 12 along each axis, which is the same in all cells."""
    camera = dataset(former(1, kinds=("dark", "flat"))).camera.model_copy(
        update={"rows": shape[0], "cols": shape[1], "cfa": cfa}
    )
    step = mosaic.step(cfa)
    row, col = (np.arange(n) - 0.5 * (n - 1) for n in shape)
    bowl = np.square(row[:, None]) + np.square(col)
    for channel, points in _channel_points(camera, 0.0, 0.0).items():
        plane = np.mean([bowl[r::step, c::step] for r, c in mosaic.phases(cfa)[channel]], axis=0)
        predicted = _cell_means((points.x_um**2 + points.y_um**2) / camera.pixel_pitch_um**2)
        # greens of two phases: their mean place stands for the mean of their squares, 0.25 px^2 too little an axis
        two = 0.5 * (len(mosaic.phases(cfa)[channel]) - 1)
        np.testing.assert_allclose(_cells(plane).ravel(), predicted - step**2 / 6.0 + two, atol=1e-9)


def test_means_over_cells_are_exact_for_the_fourth_power() -> None:
    """x^4 over a cell from a to b: (b^5 - a^5) / (5 (b - a))."""
    camera = dataset(former(1, kinds=("dark", "flat"))).camera
    place = _cell_points(camera, 0.0, 0.0)
    edges = (np.linspace(0, camera.cols, 9) - camera.cols / 2) * camera.pixel_pitch_um
    exact = np.diff(edges**5) / (5.0 * np.diff(edges))
    np.testing.assert_allclose(_cell_means(place.x_um**4).reshape(6, 8)[2], exact, rtol=1e-9)


# --- What read-out adds to the pixels of every frame: each measurement that it changes predicts it --------------------


RAMP = ReadOutRamp(last_row_e=40.0)


@cache
def recorded() -> RecordingSet:
    return rendered(5, (RAMP,))


def without_darks(recordings: RecordingSet) -> RecordingSet:
    return recordings.without({c.id for c in recordings.captures("dark", "left")})


@pytest.mark.parametrize(
    ("make", "recordings"),
    [
        (measure_dark_field, recorded),
        (partial(measure_fixed_lines, "rows"), recorded),
        (measure_flat_field, recorded),
        (measure_flat_rows, lambda: without_darks(recorded())),
    ],
    ids=["dark_field", "dark_row_pattern", "flat_field", "flat_rows"],
)
def test_what_read_out_adds_is_predicted(
    make: Callable[[Dataset], Observable], recordings: Callable[[], RecordingSet]
) -> None:
    """Without the effect the numbers lie far off, with it chi-squared is within 4 of its standard deviations."""
    model = measured_model(recordings(), make)
    assert sigmas(model) > 12.0
    assert abs(sigmas(model, (RAMP,))) < 4.0


def test_the_rows_of_flats_have_the_offsets_of_dark_rows() -> None:
    """The dark frames' mean rows are subtracted: no effect has to tell them once more."""
    assert abs(sigmas(measured_model(recorded(), measure_flat_rows))) < 4.0


def test_its_mean_is_a_part_of_the_black_level() -> None:
    """The level that dark frames have at no exposure is measured with it."""
    model = measured_model(recorded(), measure_dark)
    assert abs(sigmas(model)) < 4.0
    np.testing.assert_array_equal(model.mean((RAMP,)), model.mean(()))
