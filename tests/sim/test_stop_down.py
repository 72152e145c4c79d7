"""A camera at another f-number: path errors shrink with the pupil, and what the image is displaced by stays."""

from __future__ import annotations

import numpy as np
import pytest

from lab.formats.camera_file import default_camera
from sim.effects.coma import Coma
from sim.effects.defocus import Defocus
from sim.effects.spherical_aberration import SphericalAberration
from sim.optics.pupil import seidel
from sim.point import transfer_at
from sim.stop_down import at_f_number, effects_at_f_number

CAMERA = default_camera().camera


def test_a_smaller_pupil_is_the_middle_of_the_larger_one() -> None:
    """The path error at half the height, as a function of the height over the rim, is that of the stopped effect."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9))
    effects = (SphericalAberration(w040_um=0.32), Coma(w131_x_um=0.24, w131_y_um=-0.08))
    round_one, coma = effects_at_f_number(effects, 4.0, 8.0)
    assert isinstance(round_one, SphericalAberration)
    assert isinstance(coma, Coma)
    whole = seidel(spherical_um=0.32, coma_um=(0.24, -0.08))
    part = seidel(spherical_um=round_one.w040_um, coma_um=(coma.w131_x_um, coma.w131_y_um))
    np.testing.assert_allclose(part(x, y), whole(0.5 * x, 0.5 * y), atol=1e-12)


def test_defocus_follows_the_f_number_by_itself() -> None:
    """W020 = dz / (8 N^2): at f/8, 12 um are the path error of 3 um at f/4, in units of the pupil; the frequency scales
    with the cutoff."""
    (defocus,) = effects_at_f_number((Defocus(defocus_um=12.0),), 4.0, 8.0)
    assert defocus == Defocus(defocus_um=12.0)
    base = at_f_number(CAMERA, 4.0)
    f = np.array([0.05, 0.1, 0.15])

    def lens_only(n: float, um: float, scale: float) -> np.ndarray:
        camera = at_f_number(base, n)
        with_it, without = (transfer_at(camera, 550.0, scale * f, 0.0 * f, e) for e in ((Defocus(defocus_um=um),), ()))
        return np.real(with_it / without)

    np.testing.assert_allclose(lens_only(8.0, 12.0, 1.0), lens_only(4.0, 3.0, 2.0), atol=2e-3)


def test_the_same_f_number_changes_nothing_and_bounds_hold() -> None:
    effects = (SphericalAberration(w040_um=0.32), Defocus(defocus_um=5.0))
    assert effects_at_f_number(effects, 4.0, 4.0) == effects
    (wide,) = effects_at_f_number((SphericalAberration(w040_um=3.0),), 4.0, 1.4)
    assert wide == SphericalAberration(w040_um=5.0)  # its upper bound


def test_a_lens_that_is_known_at_one_aperture_is_refused() -> None:
    """A lens drawn from a table holds for its own aperture."""

    class Table:
        kind = "traced"

    lens = CAMERA.lens.model_construct(**dict(CAMERA.lens) | {"imaging": Table()})
    with pytest.raises(ValueError, match="traced holds for f/4 alone"):
        at_f_number(CAMERA.model_copy(update={"lens": lens}), 8.0)
