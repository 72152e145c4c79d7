"""What holds of every pattern on a screen: no statement of the manifest enters its numbers, and what is predicted of an
image is what the estimator finds of it.

Frames are drawn in closed form: squares blurred by a Gaussian are products of normal distribution functions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset
from lab.observables.observable import measurements
from lab.observables.screens.bands import ACROSS, BORDER, GHOST, RADIAL, RADIAL3, SHIFT_X, PlacedPattern
from lab.observables.screens.canvas import pattern_window
from lab.observables.screens.cell_borders import BORDER_ERROR
from lab.observables.screens.contrast import CONTRAST_FLOOR
from lab.observables.screens.ghost import GHOST_ERROR
from lab.observables.screens.placement import place_pattern
from sim.camera import Cfa
from sim.sensor import mosaic

ORDERS = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
SHAPE = (176, 216)
CELLS = (40, 50)
SIGMA_PX = 0.5
DRAWN_PX = 1e-3  # of a colour's displacement, by the drawing
BOARD = (np.indices(CELLS) // 5).sum(axis=0).astype(np.uint8) % 2
PATTERN = np.random.default_rng(78).integers(0, 2, CELLS).astype(np.uint8)


def drawn(target: NDArray[np.uint8], cell_px: float, turn_rad: float) -> NDArray[np.float64]:
    """Return the picture of cells, turned about the frame's middle and blurred by a Gaussian: exact; NaN beside it."""
    row, col = (part.ravel() for part in np.indices(SHAPE, dtype=float))
    down, right = row - 0.5 * (SHAPE[0] - 1) + 0.3, col - 0.5 * (SHAPE[1] - 1) - 0.2
    y = (np.cos(turn_rad) * down - np.sin(turn_rad) * right) / cell_px + CELLS[0] / 2
    x = (np.sin(turn_rad) * down + np.cos(turn_rad) * right) / cell_px + CELLS[1] / 2
    sigma = SIGMA_PX / cell_px
    padded = np.pad(target.astype(float), 60)
    light = np.zeros(y.size)
    for i in range(-2, 3):
        high = ndtr((y - np.floor(y) - i) / sigma) - ndtr((y - np.floor(y) - i - 1) / sigma)
        for j in range(-2, 3):
            wide = ndtr((x - np.floor(x) - j) / sigma) - ndtr((x - np.floor(x) - j - 1) / sigma)
            at = (
                np.clip(np.floor(y).astype(int) + i + 60, 0, padded.shape[0] - 1),
                np.clip(np.floor(x).astype(int) + j + 60, 0, padded.shape[1] - 1),
            )
            light += padded[at] * high * wide
    beside = (np.abs(y - 0.5 * CELLS[0]) > 0.5 * CELLS[0] - 0.5) | (np.abs(x - 0.5 * CELLS[1]) > 0.5 * CELLS[1] - 0.5)
    return np.where(beside, np.nan, light).reshape(SHAPE)


def gaussian(fx: NDArray[np.float64], fy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transfer function of the blur."""
    return np.asarray(np.exp(-2.0 * np.square(np.pi * SIGMA_PX) * (fx**2 + fy**2)))


@pytest.mark.parametrize("cfa", ORDERS)
@pytest.mark.parametrize(
    ("cell_px", "turn_rad", "contrast"),
    [(4.1, 0.03, 3.0 * CONTRAST_FLOOR), (4.0, 0.001, 0.01)],
    ids=["turned", "square"],
)
def test_what_is_predicted_of_an_image_is_what_the_estimator_finds(
    cfa: Cfa, cell_px: float, turn_rad: float, contrast: float
) -> None:
    """Without noise, within three times the errors of the drawing, and of the pattern's place; displacements to 0.003
    px. Of cells of a whole number of pixels that stand square, a band near 1/2 cy/px is told from its aliases by the
    drawing's last digits: 1 %."""
    board, picture = (drawn(one, cell_px, turn_rad) for one in (BOARD, PATTERN))
    place = place_pattern(board, picture, BOARD, PATTERN, cell_px, cfa)
    assert place.transfer is not None
    placed = PlacedPattern.of(
        PATTERN.astype(float), place.warp, place.transfer, pattern_window(picture, place.warp, CELLS), picture
    )
    for places in mosaic.phases(cfa).values():
        found = placed.regress(places, mosaic.step(cfa), displaced=True)
        design = found.design
        seen = design.coefficients(picture[design.canvas.window][design.mask])
        away = seen - design.coefficients(design.canvas.image(gaussian)[design.mask])
        of_place = np.sqrt(np.sum(np.square(design.by_place @ place.std.T), axis=1))
        bands = slice(1, design.bands)
        assert np.all(np.abs(away[bands]) < np.hypot(contrast, 3.0 * of_place[bands]))
        for at, floor in ((BORDER, BORDER_ERROR), (GHOST, GHOST_ERROR)):
            assert abs(away[design.bands + at]) < 3.0 * np.hypot(floor, of_place[design.bands + at])
        shifts = away[design.shifts] + found.moved
        reach = design.reach
        for at in (RADIAL, RADIAL3, ACROSS):
            assert abs(shifts[at - SHIFT_X]) * reach < 3.0 * np.hypot(DRAWN_PX, of_place[design.bands + at] * reach)


def restated(recordings: RecordingSet, of_camera: dict[str, Any], of_screens: dict[str, Any]) -> RecordingSet:
    """Return the same frames with other statements; numbers of the screens' captures are added to what is stated."""
    document = recordings.manifest.model_dump(mode="json", exclude_none=True)
    document["cameras"]["left"] |= of_camera
    for capture in document["captures"]:
        for key, value in of_screens.items() if "screen" in capture else ():
            capture[key] += value
    return recordings.under(Manifest.model_validate(document))


@pytest.mark.parametrize(
    ("of_camera", "of_screens"),
    [
        ({"black_level_dn": 0.0}, {}),
        ({"f_number": 8.0}, {}),
        ({"pixel_pitch_um": 9.0, "fill_factor": 0.3}, {}),
        ({"conversion_gain_dn_per_e": 3.0}, {}),
        ({}, {"exposure_s": 12.0}),
    ],
    ids=["black level", "f-number", "pitch", "gain", "exposure"],
)
def test_no_statement_enters_the_numbers(of_camera: dict[str, Any], of_screens: dict[str, Any]) -> None:
    """Bit for bit, of what is measured of screens from the regression of patterns."""
    given = recordings_of(ConcealedCamera(65, (), cfa="GRBG", rows=96, cols=128), Plan(kinds=("dark", "screen")))
    of_patterns = [m for m in measurements() if m.name in {"bernoulli", "cell_borders", "ghost", "lateral_colour"}]
    found = []
    for recordings in (given, restated(given, of_camera, of_screens)):
        dataset = Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))
        found.append({m.name: m.make(dataset) for m in of_patterns})
    for name, block in found[0].items():
        other = found[1][name]
        kept = [k for k, label in enumerate(block.labels) if label in other.labels]
        assert kept
        np.testing.assert_array_equal(
            block.value[kept], [other.value[other.labels.index(block.labels[k])] for k in kept]
        )


def test_an_uneven_white_screen_is_no_light_at_borders() -> None:
    """A white screen that loses 0.4 % towards the frame's corners, as a tail of the point spread function takes at its
    border, and 0.2 % of light that is added: only the drawing's error of the pattern, 1e-3 at most, is left of it."""
    board, picture = (drawn(one, 4.1, 0.03) for one in (BOARD, PATTERN))
    row, col = (np.linspace(-1.0, 1.0, n) for n in SHAPE)
    lost = 0.004 * (row[:, None] ** 2 + 0.5 * col**2) + 0.001 * col
    uneven = (picture + 0.002 * row[:, None] ** 2) * (1.0 + lost)
    place = place_pattern(board, picture, BOARD, PATTERN, 4.1, "MONO")
    assert place.transfer is not None
    window = pattern_window(picture, place.warp, CELLS)
    placed = PlacedPattern.of(PATTERN.astype(float), place.warp, place.transfer, window, picture)
    design = placed.regress(((0, 0),), 1, displaced=False).design
    away = (design.weights @ (uneven - picture)[window][design.mask])[design.bands :]
    assert np.abs(away[[BORDER, GHOST]]).max() < 5e-6
