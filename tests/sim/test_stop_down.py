"""A camera at another f-number: path errors shrink with the pupil, and what the image is displaced by stays."""

from __future__ import annotations

import numpy as np
import pytest

from lab.formats.camera_file import default_camera
from sim.effects.astigmatism import Astigmatism
from sim.effects.coma import Coma
from sim.effects.defocus import Defocus
from sim.effects.spherical_aberration import SphericalAberration
from sim.effects.trefoil import Trefoil
from sim.effects.veiling_glare import VeilingGlare
from sim.optics.pupil import pupil_otf, seidel
from sim.point import transfer_at
from sim.stop_down import at_f_number, effects_at_f_number

CAMERA = default_camera().camera


def test_a_smaller_pupil_is_the_middle_of_the_larger_one() -> None:
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9))
    whole = seidel(spherical_um=0.32, coma_um=(0.24, -0.08), defocus_um=0.2, astigmatism_um=0.1, astigmatism_deg=20.0)
    np.testing.assert_allclose(whole.stopped(0.5)(x, y), whole(0.5 * x, 0.5 * y), atol=1e-12)


SIZE = 1.2
#: An effect whose path error at the rim of f/4 is 1.2 um, the power of the pupil that it goes with (Seidel), and the
#: mean square over the pupil of its slope along x about its mean, for a path error of 1: of r^4 (4 r^2 x)^2 = 2, of
#: r^2 x (3 x^2 + y^2)^2 - 1 = 1/2, of x^3 - 3 x y^2 (3 x^2 - 3 y^2)^2 = 3/2, of x^2 - y^2, and of r^2, (2 x)^2 = 1.
RIM_LAWS = {
    "spherical": (SphericalAberration(w040_um=SIZE), 4, 2.0),
    "coma": (Coma(w131_x_um=SIZE), 3, 0.5),
    "trefoil": (Trefoil(w333_x_um=SIZE), 3, 1.5),
    "astigmatism": (Astigmatism(defocus_x_um=SIZE * 128.0, defocus_y_um=SIZE * 128.0), 2, 1.0),
    "defocus": (Defocus(defocus_um=SIZE * 128.0), 2, 1.0),
}


@pytest.mark.parametrize("f_number", [2.8, 4.0, 8.0])
@pytest.mark.parametrize("law", RIM_LAWS)
def test_rays_land_as_far_off_as_the_seidel_sums_say(law: str, f_number: float) -> None:
    """Rays land 2 N dW/dx off, so that at low frequencies f the contrast is 1 - 2 pi^2 f^2 (2 N)^2 <(dW/dx)^2>, with W
    the path error of f/4 times (4 / N)^power. The next term is a sixth of the loss squared; the overlap of the
    pupils at 0.01 of the cutoff leaves 3 % of the mean out."""
    effect, power, slope = RIM_LAWS[law]
    rms_um = 2.0 * f_number * SIZE * (4.0 / f_number) ** power * np.sqrt(slope)
    f = np.array([min(0.02 / rms_um, 0.01 / (0.55 * f_number))])
    (acting,) = effects_at_f_number((effect,), 4.0, f_number)
    camera, px = at_f_number(CAMERA, f_number), f * CAMERA.pixel_pitch_um
    with_it, without = (abs(transfer_at(camera, 550.0, px, 0.0 * px, e)[0]) for e in ((acting,), ()))
    assert 1.0 - with_it / without == pytest.approx(2.0 * np.pi**2 * f[0] ** 2 * rms_um**2, rel=0.06)


def test_the_spherical_part_of_a_defocus_shrinks_faster_than_the_whole() -> None:
    """W = dz / (8 N^2) (r^2 + s ((N0 / N)^2 r^4 - r^2)): of 0.1 at f/4, at f/8 a quarter is left."""
    (defocus,) = effects_at_f_number((Defocus(defocus_um=12.0, spherical_share=0.1),), 4.0, 8.0)
    f, camera = np.array([0.05, 0.15]), at_f_number(CAMERA, 8.0)
    px = f * CAMERA.pixel_pitch_um
    plain = transfer_at(camera, 550.0, px, 0.0 * px, ()) / pupil_otf(f, 0.0 * f, 550.0, 8.0, seidel())
    w020 = 12.0 / (8.0 * 64.0)
    wanted = pupil_otf(f, 0.0 * f, 550.0, 8.0, seidel(defocus_um=0.9 * w020, spherical_um=0.025 * w020))
    np.testing.assert_allclose(transfer_at(camera, 550.0, px, 0.0 * px, (defocus,)), plain * wanted, atol=1e-5)


def test_defocus_follows_the_f_number_by_itself() -> None:
    """W020 = dz / (8 N^2): at f/8, 12 um are the path error of 3 um at f/4, in units of the pupil; the frequency scales
    with the cutoff."""
    (defocus,) = effects_at_f_number((Defocus(defocus_um=12.0),), 4.0, 8.0)
    assert defocus == Defocus(defocus_um=12.0, stated_f_number=4.0)
    base = at_f_number(CAMERA, 4.0)
    f = np.array([0.05, 0.1, 0.15])

    def lens_only(n: float, um: float, scale: float) -> np.ndarray:
        camera = at_f_number(base, n)
        with_it, without = (transfer_at(camera, 550.0, scale * f, 0.0 * f, e) for e in ((Defocus(defocus_um=um),), ()))
        return np.real(with_it / without)

    np.testing.assert_allclose(lens_only(8.0, 12.0, 1.0), lens_only(4.0, 3.0, 2.0), atol=2e-3)


def test_the_same_f_number_changes_nothing_and_what_is_stated_stays() -> None:
    effects = (SphericalAberration(w040_um=0.32), Defocus(defocus_um=5.0))
    assert effects_at_f_number(effects, 4.0, 4.0) == effects
    stated = SphericalAberration(w040_um=3.0, stated_f_number=2.0)
    assert effects_at_f_number((stated,), 4.0, 1.4) == (stated,)
    assert effects_at_f_number((VeilingGlare(share_percent=1.0),), 4.0, 1.4) == (VeilingGlare(share_percent=1.0),)


def test_a_lens_that_is_known_at_one_aperture_is_refused() -> None:
    """A lens drawn from a table holds for its own aperture."""

    class Table:
        kind = "traced"

    lens = CAMERA.lens.model_construct(**dict(CAMERA.lens) | {"imaging": Table()})
    with pytest.raises(ValueError, match="traced holds for f/4 alone"):
        at_f_number(CAMERA.model_copy(update={"lens": lens}), 8.0)
