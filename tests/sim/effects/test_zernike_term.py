"""Zernike terms above trefoil: the polynomials, what is orthogonal, the light and the turns that they keep."""

from __future__ import annotations

import numpy as np
import pytest

from sim.effects.secondary_astigmatism import SecondaryAstigmatism
from sim.effects.secondary_coma import SecondaryComa
from sim.effects.tetrafoil import Tetrafoil
from sim.effects.zernike_term import ZernikeTerm
from sim.optics.pupil import Wavefront, pupil_otf, seidel
from sim.spectrum import FloatArray
from sim.stages import Image
from tests.sim.test_stop_down import CAMERA

TERMS = [SecondaryAstigmatism, SecondaryComa, Tetrafoil]
ANGLE = np.linspace(0.0, 2.0 * np.pi, 25)


def _path(effect: ZernikeTerm) -> Wavefront:
    return effect.on_image(Image(CAMERA)).wavefront(550.0)


def _otf(path: Wavefront, fx: FloatArray, fy: FloatArray) -> FloatArray:
    return np.asarray(pupil_otf(fx, fy, 550.0, 4.0, path))


@pytest.mark.parametrize(
    ("effect", "wanted"),
    [
        (
            SecondaryAstigmatism(cos_um=0.3, sin_um=-0.2),
            lambda r, t: (4.0 * r**4 - 3.0 * r**2) * (0.3 * np.cos(2.0 * t) - 0.2 * np.sin(2.0 * t)),
        ),
        (
            SecondaryComa(cos_um=0.3, sin_um=-0.2),
            lambda r, t: (10.0 * r**5 - 12.0 * r**3) * (0.3 * np.cos(t) - 0.2 * np.sin(t)),
        ),
        (
            Tetrafoil(cos_um=0.3, sin_um=-0.2),
            lambda r, t: r**4 * (0.3 * np.cos(4.0 * t) - 0.2 * np.sin(4.0 * t)),
        ),
    ],
    ids=lambda one: getattr(one, "name", ""),
)
def test_the_path_error_is_the_textbooks_polynomial(effect: ZernikeTerm, wanted) -> None:
    for r in (0.3, 0.8, 1.0):
        np.testing.assert_allclose(_path(effect)(r * np.cos(ANGLE), r * np.sin(ANGLE)), wanted(r, ANGLE), atol=1e-12)


def test_terms_are_orthogonal_over_the_pupil() -> None:
    """By 200 rings and 24 angles: exact in the angle, to 1e-4 in the radius. Coma's and secondary coma's tilts, which
    they are orthogonal with, are left out of the effects."""
    r = np.sqrt((np.arange(200) + 0.5) / 200.0)[:, None]
    t = np.arange(24) * 2.0 * np.pi / 24.0
    x, y = r * np.cos(t), r * np.sin(t)
    values = [_path(kind.model_validate({"cos_um": 1.0}))(x, y) for kind in (SecondaryAstigmatism, Tetrafoil)]
    values += [seidel(astigmatism_um=1.0)(x, y) - 0.5 * (x * x + y * y)]
    products = np.array([[np.mean(one * other) for other in values] for one in values])
    np.testing.assert_allclose(products - np.diag(np.diag(products)), 0.0, atol=1e-4)


@pytest.mark.parametrize("kind", TERMS)
def test_it_keeps_the_light_and_has_no_tilt(kind: type[ZernikeTerm]) -> None:
    path = _path(kind.model_validate({"cos_um": 0.5, "sin_um": 0.3}))
    assert _otf(path, np.zeros(1), np.zeros(1)) == pytest.approx(1.0, abs=1e-12)
    assert path.tilt_um == (0.0, 0.0)


@pytest.mark.parametrize(("kind", "turn_deg"), [(SecondaryAstigmatism, 180.0), (Tetrafoil, 90.0)])
def test_a_turn_leaves_the_transfer_as_it_is(kind: type[ZernikeTerm], turn_deg: float) -> None:
    path, f, turn = _path(kind.model_validate({"cos_um": 0.2})), np.array([0.06, 0.15]), np.deg2rad(turn_deg)
    np.testing.assert_allclose(_otf(path, f, 0.0 * f), _otf(path, f * np.cos(turn), f * np.sin(turn)), atol=1e-9)


@pytest.mark.parametrize("kind", [SecondaryAstigmatism, Tetrafoil])
def test_even_terms_act_alike_with_either_sign(kind: type[ZernikeTerm]) -> None:
    f = np.array([0.06, 0.15])
    one, other = (_otf(_path(kind.model_validate({"cos_um": um})), f, 0.5 * f) for um in (0.2, -0.2))
    np.testing.assert_allclose(one, np.conj(other), atol=1e-9)
    assert np.abs(np.imag(one)).max() < 1e-9


def test_a_weak_tetrafoil_loses_contrast_as_its_mean_square_slope() -> None:
    """Rays land 2 N dW/dx off; W = Re z^4 has dW/dx = Re 4 z^3, of mean square 8 <r^6> = 2. The pupils' overlap at 1 %
    of the cutoff leaves 3 % out."""
    f = np.array([0.004])
    kept = abs(_otf(_path(Tetrafoil(cos_um=1.0)), f, 0.0 * f)[0]) / abs(_otf(seidel(), f, 0.0 * f)[0])
    assert 1.0 - kept == pytest.approx(2.0 * np.pi**2 * f[0] ** 2 * 8.0**2 * 2.0, rel=0.06)


@pytest.mark.parametrize("kind", TERMS)
def test_absent_it_is_the_lens_alone(kind: type[ZernikeTerm]) -> None:
    image = Image(CAMERA)
    assert kind().on_image(image) is image
