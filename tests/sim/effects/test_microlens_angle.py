"""Microlenses at another angle: what a corner loses and gives to its neighbours, and none is lost between these."""

from __future__ import annotations

import numpy as np
import pytest

from sim.camera import Cfa
from sim.effects.microlens_angle import MicrolensAngle
from sim.frame import Exposure, expected_electrons
from sim.scene.scenes import UniformField
from sim.sensor import mosaic
from sim.spectrum import Spectrum
from sim.uniform import FieldPoints, Uniform, electron_rate
from tests.sim.effects.test_light_effects import CAMERA

#: A light that red, green and blue pixels see unlike each other.
WAVELENGTH = np.arange(400.0, 701.0)
COLOURED = CAMERA.model_copy(
    update={
        "dark_current_e_per_s": 0.0,
        "quantum_efficiency": {
            c: Spectrum.of(WAVELENGTH, np.full(301, q)) for c, q in {"R": 0.2, "G": 0.5, "B": 0.3}.items()
        },
    }
)
LIGHT = Spectrum.of(WAVELENGTH, np.full(301, 0.02))
MIXED = MicrolensAngle(crosstalk_percent=4.0, red_excess=0.5)


def test_the_corner_loses_light_and_mixes_its_colours() -> None:
    """In the corner, of R : G : B = 2 : 5 : 3: R (1 - 1.5 c) + c G, and G (1 - c) + c (1.5 R + 0.5 B) / 2."""
    one = Uniform(COLOURED, (MIXED, MicrolensAngle(loss_percent=10.0)))
    corner = FieldPoints(np.array([0.0, 80.0]), np.array([0.0, 60.0]), np.ones(2))
    found = one.stray_light({"R": 2.0 * np.ones(2), "G": 5.0 * np.ones(2), "B": 3.0 * np.ones(2)}, corner)
    assert found["R"] == pytest.approx([2.0, 2.0 - 0.06 * 2.0 + 0.04 * 5.0])
    assert found["G"] == pytest.approx([5.0, 5.0 - 0.04 * 5.0 + 0.5 * (0.06 * 2.0 + 0.02 * 3.0)])
    assert one.field(corner).light == pytest.approx([1.0, 0.9])
    # green on red rows: red along x^2 = 0.64, blue along y^2 = 0.36
    parted = one.part_greens({"R": 2.0 * np.ones(2), "B": 3.0 * np.ones(2)}, corner)
    assert parted == pytest.approx([0.0, (0.64 - 0.36) * (0.06 * 2.0 - 0.02 * 3.0)])


def test_no_light_is_lost_between_neighbours() -> None:
    """But for the outermost pixels, beyond which the frame is mirrored: of 60 + 80 lines 4, with 4 % at most."""
    plain, mixed = (expected_electrons(COLOURED, Exposure(UniformField(LIGHT), 0.001), e) for e in ((), (MIXED,)))
    assert mixed.sum() == pytest.approx(plain.sum(), rel=0.04 * 4 / 140)
    assert np.abs(mixed / plain - 1.0).max() > 0.02


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_channels_and_greens_are_those_of_frames(cfa: Cfa) -> None:
    camera = COLOURED.model_copy(update={"cfa": cfa})
    plain, frame = (expected_electrons(camera, Exposure(UniformField(LIGHT), 0.001), e) for e in ((), (MIXED,)))
    one = Uniform(camera, (MIXED,))
    rates = {c: np.array(electron_rate(camera, c, LIGHT)) for c in "RGB"}
    row, col = (20 + mosaic.phases(cfa)["G"][0][0], 70 + mosaic.phases(cfa)["G"][0][1])
    place = one.field(FieldPoints.at(camera, np.full(1, float(row)), np.full(1, float(col))))
    found = one.electrons(rates, np.array(0.001), field=place)
    even = {c: rates[c] * 0.001 * place.light for c in "RGB"}
    square = (frame / plain)[row - 1 : row + 2, col - 1 : col + 2]
    on_blue_rows = float(np.mean([square[0, 0], square[0, 2], square[2, 0], square[2, 2]]))
    # around a green pixel the mean of x^2 is that at the pixel and a pixel's square: 1 of 900
    level = float((found["G"] / even["G"])[0])
    assert 0.5 * (square[1, 1] + on_blue_rows) == pytest.approx(level, abs=0.04 / 900)
    parted = float((one.part_greens(even, place) / even["G"])[0])
    assert abs(parted) > 0.003
    assert square[1, 1] - on_blue_rows == pytest.approx(parted, abs=0.04 / 900)


def test_without_a_mosaic_it_is_absent() -> None:
    mono = CAMERA.model_copy(update={"cfa": "MONO", "quantum_efficiency": {"Y": COLOURED.quantum_efficiency["G"]}})
    assert not Uniform(mono, (MicrolensAngle(crosstalk_percent=5.0, loss_percent=5.0),)).strays
