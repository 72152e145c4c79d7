"""Colour characterisation: cameras whose index is known, intervals, and colour-science's differences."""

from __future__ import annotations

import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.formats.results import SpectralFit
from lab.standards.iso17321 import (
    CHROMATIC,
    GRID_NM,
    ILLUMINANT,
    Colorimetry,
    _observer,
    _test_colours,
    fit_matrix,
    from_curves,
    illuminant_power,
)
from sim.scene.light import colour_science

MIX = np.array([[1.0, 0.2, 0.0], [0.3, 0.9, 0.1], [0.0, 0.1, 0.8]])


def truth() -> Colorimetry:
    return Colorimetry.under(illuminant_power(ILLUMINANT), _test_colours())


def gaussian_curves(width_nm: float = 35.0) -> np.ndarray:
    return np.stack([np.exp(-0.5 * ((GRID_NM - centre) / width_nm) ** 2) for centre in (600.0, 540.0, 460.0)])


def fit(curves: np.ndarray, std: np.ndarray | None = None) -> SpectralFit:
    names = ("R", "G", "B")
    std = np.full_like(curves, 1e-6) if std is None else std
    return SpectralFit(
        wavelength_nm=tuple(GRID_NM.tolist()),
        quantum_efficiency={name: tuple(row) for name, row in zip(names, curves.tolist(), strict=True)},
        quantum_efficiency_std={name: tuple(row) for name, row in zip(names, std.tolist(), strict=True)},
    )


def test_camera_that_mixes_the_observers_curves_has_an_index_of_100() -> None:
    """Luther's condition: signals are a linear function of tristimulus values, and a matrix takes them back."""
    curves = MIX @ (_observer() / GRID_NM[:, None]).T  # per photon
    found, _ = from_curves(fit(curves))
    assert found.smi == pytest.approx(100.0, abs=1e-3)
    white_balance = MIX @ truth().white
    # xyz = inverse(MIX) rgb, and rgb is divided by white's
    np.testing.assert_allclose(found.matrix, np.linalg.inv(MIX) * white_balance, atol=1e-4)


def test_matrix_keeps_white() -> None:
    found, _ = from_curves(fit(gaussian_curves()))
    np.testing.assert_allclose(found.matrix.sum(axis=1), truth().white, rtol=1e-12)


def test_differences_are_those_of_colour_science() -> None:
    colour, own = colour_science(), truth()
    signals = _test_colours() @ (gaussian_curves() * illuminant_power(ILLUMINANT) * GRID_NM).T
    white = (gaussian_curves() * illuminant_power(ILLUMINANT) * GRID_NM).sum(axis=1)
    found = fit_matrix(signals, white, own)
    lab = [
        colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(own.white)) for xyz in (own.patches, (signals / white) @ found.matrix.T)
    ]
    expected = colour.delta_E(*lab, method="CIE 1976")[:CHROMATIC].mean()
    assert found.mean_difference == pytest.approx(expected, rel=1e-9)


def test_white_is_that_of_the_illuminant() -> None:
    """D55's chromaticity of the CIE's tables, on a grid of 5 nm."""
    colour = colour_science()
    x, y = colour.XYZ_to_xy(truth().white)
    wanted = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D55"]
    assert (x, y) == pytest.approx(tuple(wanted), abs=3e-4)


@pytest.mark.extra
def test_intervals_hold() -> None:
    """The index over 100 draws of sensitivities with 1 % noise; draws of draws are as many as a reading takes."""
    rng, curves = np.random.default_rng(6), gaussian_curves()
    std = 0.01 * np.ones_like(curves)
    exact = from_curves(fit(curves))[0].smi
    held = 0
    for _ in range(100):
        noisy = curves + std * rng.standard_normal(curves.shape)
        found, drawn = from_curves(fit(noisy, std))
        values = np.array([one.smi for one in drawn])
        held += abs(2.0 * found.smi - values.mean() - exact) < 1.96 * values.std(ddof=1)
    assert 90 <= held <= 99, held


def test_curves_of_one_channel_are_refused() -> None:
    one = fit(gaussian_curves()).model_copy(update={"quantum_efficiency": {"Y": tuple(gaussian_curves()[1].tolist())}})
    with pytest.raises(NotDetermined, match="no sensitivities of R, G and B"):
        from_curves(one)
