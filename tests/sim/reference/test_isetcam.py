"""The numbers an ISETCam user gets, where ISETCam is right (its README says where it isn't)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from sim.camera import CameraModel, Lens
from sim.effects.optical_low_pass_filter import OpticalLowPassFilter
from sim.frame import Exposure, expected_electrons
from sim.optics.filters import birefringent_spots
from sim.optics.illumination import irradiance_factor, relative_illumination
from sim.point import optical_transfer
from sim.scene.scenes import SpectralImage
from sim.scene.warp import Warp
from sim.sensor import mosaic
from sim.sensor.electrons import FixedPattern, dn_moments, sample_from
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import electron_rate

REFERENCE = Path(__file__).parents[4] / "shared" / "reference" / "isetcam"
pytestmark = pytest.mark.skipif(
    not REFERENCE.is_dir(), reason="the ISETCam reference numbers are not beside the repository"
)


def table(name: str) -> np.ndarray:
    return np.genfromtxt(REFERENCE / name, delimiter=",", names=True, dtype=None, encoding="utf-8")


def lines(wavelength_nm: FloatArray, photons: FloatArray) -> Spectrum:
    """ISETCam sums bins of 10 nm: photons (per nm) become lines of 2 pm that hold a bin's energy."""
    w = np.asarray(wavelength_nm, float)
    energy = np.asarray(photons, float) * 10.0 * 1.986445857148928e-16 / w
    knots = (w[:, None] + np.array([-0.001, 0.0, 0.001])).ravel()
    return Spectrum.of(knots, (energy[:, None] / 0.001 * np.array([0.0, 1.0, 0.0])).ravel())


def curve(wavelength_nm: FloatArray, value: FloatArray) -> Spectrum:
    """A sensitivity that holds 1 nm beyond its ends, so that the outermost lines are whole."""
    w = [wavelength_nm[0] - 1.0, *wavelength_nm, wavelength_nm[-1] + 1.0]
    return Spectrum.of(w, [value[0], *value, value[-1]])


def camera(f_number: float, fill_factor: float, efficiency: dict[str, Spectrum], **changes: object) -> CameraModel:
    """DN are thousandths of an electron, so that rounding is nothing, and clip at 10000 e as 1 V does."""
    values = {
        "rows": 128, "cols": 128, "pixel_pitch_um": 2.0, "fill_factor": fill_factor,
        "cfa": "MONO" if "Y" in efficiency else "RGGB", "bit_depth": 16, "black_level_dn": 0.0, "white_level_dn": 1e7,
        "conversion_gain_dn_per_e": 1000.0, "full_well_e": 1e9, "read_noise_e": 0.0, "dark_current_e_per_s": 0.0,
        "dsnu_e": 0.0, "prnu_percent": 0.0, "quantum_efficiency": efficiency,
        "lens": Lens(f_number=f_number, focal_length_mm=4.0),
    }  # fmt: skip
    return CameraModel.model_validate(values | changes)


def test_radiometry_of_24_patches() -> None:
    m = loadmat(REFERENCE / "radiometry.mat")
    w = m["wave"].ravel().astype(float)
    chain = m["sqe"] * m["trans"].ravel()[:, None]
    model = camera(
        float(m["fN"].item()),
        float(m["fillfactor"].item()),
        {channel: curve(w, chain[:, k]) for k, channel in enumerate("RGB")},
    )
    assert m["pix_w"].item() == pytest.approx(2e-6)
    for patch, wanted in zip(m["patch_photons"], m["pm_volts"], strict=True):
        light = lines(w, patch)
        for channel, volts in zip("RGB", wanted, strict=True):
            rate = electron_rate(model, channel, light, magnification=float(m["m"].item()))
            # The closed form itself agrees with ISETCam's volts to 6e-7.
            assert rate * m["texp"].item() * m["cg"].item() == pytest.approx(volts, rel=1e-5)


def test_electrons_of_24_patches_behind_a_diffracting_lens() -> None:
    """Means of the middle 24 x 24 px of every patch of 58.52 px, within 0.2 %.

    What their chart is: 6 x 4 patches of 16 x 16 samples without a frame, in darkness, padded by an eighth of its size
    on each side (12 and 8 samples) and blurred by FFT, so that light wraps around a field of 120 x 80 samples:
    438.9 x 292.6 px of 2 um. The field here is that, rounded to 439 x 293 px, without a margin, so that it wraps alike.
    An Airy pattern's tails are long: four edges at 29 px take 4 x 0.2 % of the light out of the white patch and bring
    it to others, and a field twice as wide gives the black patch 0.8 % less. What's left, 0.11 % at most
    (0.03 % rms), is their scene's sampling at 3.66 px and the field's rounding.
    """
    spectra, patches = table("macbeth_spectra.csv"), table("macbeth_diffraction_patches.csv")
    w = spectra["wave_nm"].astype(float)
    curves = {c: curve(w, spectra[f"{c}_filter"] * spectra["pd_qe"] * spectra["ir_filter"]) for c in "RGB"}
    model = camera(4.0, 0.75, curves, rows=293, cols=439)
    size, middle = 58.5209, (0.5 * (model.rows - 1), 0.5 * (model.cols - 1))
    knots, _ = lines(w, np.ones(w.size)).arrays
    cube = np.zeros((4, 6, knots.size))
    for index in range(24):
        cube[divmod(index, 6)] = lines(w, spectra["illum_photons"] * spectra[f"refl_{index + 1:02d}"]).arrays[1]
    origin = middle[0] - 2 * size, middle[1] - 3 * size
    to_camera = Warp(((size, 0.0, origin[1]), (0.0, size, origin[0]), (0.0, 0.0, 1.0)))
    scene = SpectralImage(tuple(knots), cube, to_camera)
    electrons = expected_electrons(model, Exposure(scene, 0.1), (), oversample=2, margin_px=0)
    magnified = irradiance_factor(4.0, 0.00334448) / irradiance_factor(4.0)
    # the fall-off is off in theirs
    electrons *= magnified / relative_illumination(model, np.arange(293)[:, None], np.arange(439)[None, :])
    for index, patch in enumerate(patches):
        row, col = (2 * round(0.5 * (origin[k] + size * (n + 0.5))) - 12 for k, n in enumerate(divmod(index, 6)))
        planes = mosaic.planes(electrons[row : row + 24, col : col + 24], "RGGB")
        for channel, name in [("R", "R_e"), ("G1", "Gr_e"), ("G2", "Gb_e"), ("B", "B_e")]:
            assert np.mean(planes[channel]) == pytest.approx(patch[name], rel=2e-3)


@pytest.mark.parametrize("row", table("noise.csv") if REFERENCE.is_dir() else [], ids=lambda r: f"{r[0]}-{r[1]}-{r[3]}")
def test_noise(row: np.void) -> None:
    inputs = loadmat(REFERENCE / "noise_inputs.mat")
    field, config, exposure_s = str(row["field"]), str(row["config"]), float(row["exp_s"])
    on = {name for name in ("read", "dark", "dsnu", "prnu") if config in (f"{name}_only", "all")}
    qe = Spectrum.of([300.0, 900.0], [1.0, 1.0])
    volt = float(inputs["cg"].item())
    model = camera(
        4.0,
        0.75,
        {"Y": qe},
        read_noise_e=float(inputs["rd"].item()) / volt if "read" in on else 0.0,
        dark_current_e_per_s=float(inputs["dk"].item()) / volt if "dark" in on else 0.0,
        dsnu_e=float(inputs["ds"].item()) / volt if "dsnu" in on else 0.0,
        prnu_percent=float(inputs["pr"].item()) if "prnu" in on else 0.0,
    )
    light = float(inputs["rate"].item()) * exposure_s if field == "flat" else 0.0
    dark = model.dark_current_e_per_s * exposure_s
    electrons = np.full((128, 128), light + dark)
    # What can't be negative is read above a black level, so that the normal law's lower half isn't clipped.
    black = 0.0 if "read" in on else 100.0
    model = model.model_copy(update={"black_level_dn": 1000.0 * black, "white_level_dn": 1e7 + 1000.0 * black})
    mean, variance = dn_moments(electrons, model)
    mean, variance = mean / 1000.0 - black, variance / 1e6
    spatial = (light * model.prnu_percent / 100) ** 2 + model.dsnu_e**2
    unclipped = light > 100 and exposure_s < 0.1
    if unclipped:
        assert mean[0, 0] == pytest.approx(row["pred_mean_e"], rel=1e-6)
        # ISETCam's prediction carries the PRNU on the variance of the noise too: (1 + 0.02^2) var.
        assert variance[0, 0] * (1 + (model.prnu_percent / 100) ** 2) + spatial == pytest.approx(
            row["pred_var_e2"], rel=3e-3
        )
        if not on & {"prnu", "all"}:
            assert variance[0, 0] + spatial == pytest.approx(row["pred_var_e2"], rel=1e-6)
    # ISETCam measured 128 x 128 x 8 values, clipped at 0 V and 1 V: so does this. Four standard errors of the two:
    # temporal noise averages over all values, a pattern over the pixels; a variance's is sqrt((m4 - v^2) / n).
    digital = model.model_copy(update={"conversion_gain_dn_per_e": 6.0, "black_level_dn": 0.0, "white_level_dn": 6e4})
    rng = np.random.default_rng(1)
    pattern = FixedPattern.draw(digital, rng)
    frames = np.stack([sample_from(electrons, digital, rng, pattern, dark_electrons=dark) / 6.0 for _ in range(8)])
    n = frames[0].size if on & {"dsnu", "prnu"} else frames.size
    away = frames - frames.mean()
    spread = np.sqrt(max(np.mean(away**4) - frames.var() ** 2, 0.0))
    assert frames.mean() == pytest.approx(row["mean_e"], abs=4 * np.sqrt(2 * frames.var() / n))
    # codes of 1/6 electron add (1/6)^2 / 12 where there's read noise or a pattern
    assert frames.var() == pytest.approx(row["var_e2"], abs=4 * np.sqrt(2 / n) * spread + 0.0024)


def test_analytic_contrast_with_and_without_a_birefringent_filter() -> None:
    m = table("mtf.csv")
    model = camera(4.0, 1.0, {"Y": Spectrum.of([300.0, 900.0], [1.0, 1.0])})
    line = Spectrum.of([549.999, 550.0, 550.001], [0.0, 1.0, 0.0])
    f = m["freq_cy_mm"] * 1e-3 * 2.0
    np.testing.assert_allclose(optical_transfer(model, "Y", line, f, 0 * f), m["analytic_noaa"], atol=1e-4)
    # their d is the distance of a spot from the middle: two spots are 2 um apart
    filtered_twice = OpticalLowPassFilter(displacement_x_um=2.0, displacement_y_um=2.0)
    filtered = np.abs(optical_transfer(model, "Y", line, f, 0 * f, (filtered_twice,)))
    column = next(name for name in m.dtype.names if re.match("ana_gauss1_aa", name))
    np.testing.assert_allclose(filtered, m[column], atol=1e-4)


def test_birefringent_kernel() -> None:
    """Four spots at +-1.1 um, a quarter of the light each, which theirs shares out linearly among the nearest samples,
    of 0.2508 um.
    """
    kernel = loadmat(REFERENCE / "birefringent_kernel.mat")["k"]
    kernel = np.where(np.isfinite(kernel), kernel, 0.0)  # their interpolation has no value at the rim
    positions, shares = birefringent_spots(2.2, 2.2)
    row, col = np.indices(kernel.shape) - 64.0
    # how far out the spots lie in samples, of all their light: the sample's pitch, which is stated to four digits
    pitch_um = 1.1 / (np.sum(np.abs(col) * kernel) / np.sum(kernel))
    assert pitch_um == pytest.approx(0.2508, abs=5e-5)
    hats = [
        share * np.maximum(1 - np.abs(col - x / pitch_um), 0) * np.maximum(1 - np.abs(row - y / pitch_um), 0)
        for (x, y), share in zip(positions, shares, strict=True)
    ]
    np.testing.assert_allclose(sum(hats), kernel, atol=1e-12)
