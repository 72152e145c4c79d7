"""Gains of lines: true covariance on healthy cameras, gains that are found, and what only looks like them."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.independent_simulator import ConcealedCamera
from evaluation.independent_simulator.laws import (
    ColumnNoiseLaw,
    LineGainLaw,
    OnChipSmoothingLaw,
    PhaseDetectionRowsLaw,
    TapGainLaw,
)
from lab.errors import NotDetermined
from lab.observables.flats import line_gains
from lab.observables.flats.field import measure_flat_field
from lab.observables.flats.green_balance import measure_green_balance
from lab.observables.flats.line_gains import measure_line_gains
from lab.observables.observable import Observable
from sim.effects.base import Effect
from sim.effects.library import effect
from tests.lab.diagnose.on_blocks import dataset, former, measured_model, sigmas
from tests.lab.mono_session import MonoSession


def pulls(block: Observable, effects: tuple[Effect, ...] = ()) -> tuple[np.ndarray, float]:
    """Pulls of the numbers, and chi2 over their count."""
    prediction = block.predict(effects)
    jacobian = np.reshape(list(prediction.jacobian.values()), (-1, len(block.value)))
    covariance = block.covariance + jacobian.T @ jacobian
    away = block.value - prediction.mean
    return away / np.sqrt(np.diag(covariance)), float(away @ np.linalg.solve(covariance, away)) / len(away)


@pytest.mark.parametrize(("lines", "shape"), [("columns", (48, 96)), ("rows", (48, 96)), ("rows", (64, 64))])
def test_powers_of_white_images_are_unbiased_and_scatter_as_said(
    lines: line_gains.Lines, shape: tuple[int, int]
) -> None:
    """1000 images: the mean of a logarithm of variance 0.5 at most to 4 sqrt(0.5 / 1000), and what an approximate
    number of modes leaves, 0.03; the variance to 25 %, of which 4 sqrt(2 / 1000) are chance."""
    rng, images = np.random.default_rng(7), 1000
    drawn = [line_gains._powers(rng.standard_normal(shape), lines) for _ in range(images)]
    power, white = (np.log([pair[k] for pair in drawn]) for k in (0, 1))
    modes = line_gains._share_and_modes(lines, shape[1])[1]
    assert np.all(np.abs(power.mean(0) - line_gains.log_mean_bias(modes)) < 4.0 * np.sqrt(0.5 / images) + 0.03)
    np.testing.assert_allclose(power.var(0), line_gains.polygamma(1, modes), rtol=0.25)
    assert np.all(np.abs(white.mean(0)) < 0.03)


@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_healthy_cameras_have_lines_like_their_pixels(cfa: str) -> None:
    """12 numbers of each of 6 cameras: chi2 to 4 sqrt(2 / 72), and the mean pull of a direction to 4 / sqrt(6 x 3), as
    seen and held-out flats share the pattern."""
    found = [pulls(measure_line_gains(dataset(former(3100 + seed, cfa=cfa)))) for seed in range(6)]
    assert np.mean([chi2 for _, chi2 in found]) < 1.0 + 4.0 * np.sqrt(2.0 / 72.0)
    means = np.array([z.reshape(2, -1).mean(1) for z, _ in found]).mean(0)
    assert np.all(np.abs(means) < 4.0 / np.sqrt(18.0))


@pytest.mark.parametrize(("variant", "name"), [(0, "column_gain"), (1, "column_gain"), (2, "row_gain")])
@pytest.mark.parametrize("cfa", ["MONO", "RGGB"])
def test_gains_are_predicted(cfa: str, variant: int, name: str) -> None:
    """Numbers of the other direction stay; those of this one need the effect, of which they are a sample: chi2 of 12 to
    4 sqrt(2 / 12)."""
    block = measure_line_gains(dataset(former(3201, LineGainLaw(0.8, variant, 5), cfa=cfa)))
    _, without = pulls(block)
    _, with_it = pulls(block, (effect(name)(gain_percent=0.8),))
    assert without > 10.0
    assert with_it < 1.0 + 4.0 * np.sqrt(2.0 / 12.0)


@pytest.mark.parametrize(
    ("law", "known"),
    [
        (ColumnNoiseLaw(4.0, 0, 5), ()),
        (OnChipSmoothingLaw(0.4, 1, 5), ()),
        (TapGainLaw(1.0, 0, 5), (effect("taps")(gain_percent=1.0),)),
        (PhaseDetectionRowsLaw(4.0, 0, 5), ()),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_what_only_looks_like_gains_of_lines_is_none(law: object, known: tuple[Effect, ...]) -> None:
    """Offsets that stand in dark frames, too; a filter that correlates lines; areas; rows that repeat. To 5 standard
    deviations of chi2 of 12 numbers."""
    _, chi2 = pulls(measure_line_gains(dataset(former(3301, law))), known)  # type: ignore[arg-type]
    assert chi2 < 1.0 + 5.0 * np.sqrt(2.0 / 12.0)


def test_rows_of_low_frames_and_small_frames_are_skipped() -> None:
    block = measure_line_gains(dataset(MonoSession(shape=(48, 64), levels=4).recordings()))
    assert {label.condition for label in block.labels} == {"columns"}
    with pytest.raises(NotDetermined, match=r"frames of 20 px.*from 24 px"):
        measure_line_gains(dataset(MonoSession(shape=(20, 64), levels=4).recordings()))


def test_the_list_of_laws_has_it() -> None:
    camera = ConcealedCamera(1, [LineGainLaw(1.0, 2)], cfa="MONO", rows=32, cols=32)
    assert camera.laws[0].listed_effect == "row_gain"


@pytest.mark.parametrize("variant", [0, 2])
def test_other_measurements_of_even_light_know_how_lines_scatter(variant: int) -> None:
    """Cells of flats and the greens' balance: chi2 of all numbers with the effect, to 4 of its standard deviations."""
    one = effect(("column_gain", "column_gain", "row_gain")[variant])(gain_percent=0.8)
    model = measured_model(
        former(3401, LineGainLaw(0.8, variant, 5), cfa="RGGB"), measure_flat_field, measure_green_balance
    )
    assert sigmas(model, (one,)) < 4.0 < sigmas(model)


def test_pixels_of_large_images_are_judged_by_a_part_of_each_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """White noise of 2 with lines of 0.3, 600 pixels by 200 lines, on light that shades by 10 %: the lines' power is
    that by all pixels, and the pixels' power by 150 of each line is 4 within three standard deviations."""
    rng = np.random.default_rng(6)
    image = 2.0 * rng.standard_normal((600, 200)) + 0.3 * rng.standard_normal(200)
    image += 100.0 - 10.0 * np.linspace(-1.0, 1.0, 600)[:, None] ** 2
    lines, _ = line_gains._powers(image, "columns")
    monkeypatch.setattr(line_gains, "BAND_PIXELS", 30_000)
    same, pixels = line_gains._powers(image, "columns")
    np.testing.assert_allclose(same, lines, rtol=1e-9)
    modes = line_gains._share_and_modes("columns", 200)[1] * 2.0 * len(line_gains._along(150))
    assert np.all(np.abs(pixels / 4.0 - 1.0) < 3.0 / np.sqrt(modes))
