"""Numbers of photons by a photodiode's irradiance: by hand, and a camera whose quantum efficiency is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import constants

from lab.capture_kinds.flat import FlatCapture
from lab.fit.noise.noise_fit import fit_noise
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.formats.results import CameraFit, FitResult, NoiseFit
from lab.observables.flats.stated_light import photon_numbers, why_not
from lab.report.emva import data_sheets

SHAPE, PITCH_UM, WAVELENGTH_NM = (96, 96), 5.0, 530.0
QE, K_DN_PER_E = 0.6, 0.5
#: Relative standard uncertainties: of ten readings of a current, and of the diode's calibration.
READINGS_SD, CALIBRATION_SD = 0.001, 0.015
CAMERA = DataSheet(rows=SHAPE[0], cols=SHAPE[1], cfa="MONO", bit_depth=12, pixel_pitch_um=PITCH_UM)
JOULE = constants.h * constants.c / (WAVELENGTH_NM * 1e-9)  # of a photon
#: Irradiance at which a pixel gets 10,000 photons in a second.
IRRADIANCE = 1e4 * JOULE / (PITCH_UM * 1e-6) ** 2


def flat(number: int, exposure_s: float = 1.0, irradiance: float = IRRADIANCE, **keys: object) -> FlatCapture:
    told = {"id": f"f{number}", "kind": "flat", "side": "left", "frame": f"f{number}", "exposure_s": exposure_s}
    measured = {
        "wavelength_nm": WAVELENGTH_NM,
        "irradiance_w_m2": irradiance,
        "sd_irradiance_w_m2": float(np.hypot(READINGS_SD, CALIBRATION_SD)) * irradiance,
        "irradiance_calibration_sd_percent": 100.0 * CALIBRATION_SD,
    }
    return FlatCapture.model_validate(told | measured | keys)


def test_by_hand() -> None:
    """1 W/m2 of 555 nm on 5 um x 5 um for 10 ms: 2.5e-13 J, of 3.5792e-19 J a photon."""
    (found,) = photon_numbers([flat(0, 0.01, 1.0, wavelength_nm=555.0)], CAMERA).values()
    assert (found.amount, found.unit) == (pytest.approx(2.5e-13 / 3.5792e-19, rel=1e-4), "photons")
    assert found.calibration_std == pytest.approx(0.015)


def test_irradiances_that_agree_are_one_level() -> None:
    """Readings 0.2 % apart agree by 4 x sqrt(2) x 0.1 %; 3 % apart they don't, nor at another exposure."""
    given = [flat(0), flat(1, irradiance=1.002 * IRRADIANCE), flat(2, irradiance=1.03 * IRRADIANCE), flat(3, 2.0)]
    found = photon_numbers(given, CAMERA)
    assert found["f0"] == found["f1"]
    assert found["f0"].amount == pytest.approx(10010.0)
    # two readings of 0.1 % each scatter by 0.14 %, so that their mean's is at most 0.1 %
    assert found["f0"].std == pytest.approx(0.002 / np.sqrt(2) / np.sqrt(2) / 1.001, rel=1e-6)
    assert [found[id].amount for id in ("f2", "f3")] == pytest.approx([10300.0, 20000.0])


def test_behind_a_lens_or_without_a_pitch_there_are_none() -> None:
    with_lens = CAMERA.model_copy(update={"f_number": 2.8})
    assert photon_numbers([flat(0)], with_lens) == {}
    assert "the data sheet states a lens (f/2.8), and the photodiode doesn't look through it" in str(
        why_not([flat(0)], with_lens)
    )
    no_pitch = CAMERA.model_copy(update={"pixel_pitch_um": None})
    assert photon_numbers([flat(0)], no_pitch) == {}
    assert "pixel_pitch_um is unknown" in str(why_not([flat(0)], no_pitch))
    stated = flat(0, photons_per_pixel=123.0)
    assert photon_numbers([stated], CAMERA) == {}
    assert why_not([stated], with_lens) is None


def recorded(calibration: float, camera: DataSheet = CAMERA) -> RecordingSet:
    """Flats in light of one wavelength; the photodiode reads `calibration` times its irradiance, and scatters by its
    readings."""
    rng = np.random.default_rng(5)
    captures: list[dict[str, object]] = []
    frames = {}
    for exposure_s in np.linspace(0.05, 1.15, 12):
        for kind in ("dark", "flat", "dark", "flat"):
            name = f"{kind}-{len(captures)}"
            charge = QE * 1e4 * exposure_s * (kind == "flat") + 20.0 * exposure_s
            drawn = np.minimum(rng.poisson(charge, SHAPE), 6500) + 4.0 * rng.standard_normal(SHAPE)
            frames[name] = np.clip(np.rint(80.0 + K_DN_PER_E * drawn), 0, 4095).astype(np.uint16)
            capture: dict[str, object] = {
                "id": name,
                "kind": kind,
                "side": "left",
                "frame": name,
                "exposure_s": float(exposure_s),
            }
            if kind == "flat":
                told = IRRADIANCE * calibration * (1.0 + READINGS_SD * rng.standard_normal())
                capture |= flat(0, float(exposure_s), told).model_dump(mode="json", exclude_none=True) | {
                    "id": name,
                    "frame": name,
                }
            captures.append(capture)
    return RecordingSet(Manifest(cameras={"left": camera}, captures=tuple(captures)), frames)


def fitted(calibration: float, camera: DataSheet = CAMERA) -> NoiseFit:
    return fit_noise(recorded(calibration, camera), "left")


def test_the_quantum_efficiency_has_the_photodiodes_error_apart() -> None:
    right, off = fitted(1.0), fitted(1.0 + CALIBRATION_SD)
    for fit, truth in ((right, QE), (off, QE / (1.0 + CALIBRATION_SD))):
        emva = fit.emva1288["Y"]
        for found, std, systematic in (
            (fit.quantum_efficiency, fit.quantum_efficiency_std, fit.quantum_efficiency_systematic_std),
            (emva.quantum_efficiency, emva.quantum_efficiency_std, emva.quantum_efficiency_systematic_std),
        ):
            assert found is not None and std is not None
            # 4 sd: what the readings and the frames leave open, which the calibration doesn't widen
            assert abs(found - truth) < 4.0 * std
            assert systematic == pytest.approx(CALIBRATION_SD * found)
        assert emva.points.light_unit == "photons"
        assert emva.photons_systematic_std_percent == pytest.approx(100.0 * CALIBRATION_SD)
        assert emva.wavelength_nm == fit.quantum_efficiency_wavelength_nm == WAVELENGTH_NM
        assert any("the photodiode's calibration has a standard uncertainty of 1.5 %" in text for text in emva.remarks)
    # K's error, the larger part, is that of the same frames; the calibration's factor stays
    assert off.emva1288["Y"].quantum_efficiency == pytest.approx(
        right.emva1288["Y"].quantum_efficiency / (1.0 + CALIBRATION_SD), rel=1e-9
    )
    assert right.emva1288["Y"].responsivity_dn_per_photon_std < 0.002 * right.emva1288["Y"].responsivity_dn_per_photon


def test_with_a_lens_the_fit_says_why_it_has_no_quantum_efficiency() -> None:
    fit = fitted(1.0, CAMERA.model_copy(update={"f_number": 2.8}))
    assert fit.quantum_efficiency is None
    assert fit.emva1288["Y"].points.light_unit == "s"
    assert any("take the lens off" in text for text in fit.remarks)


def test_the_data_sheet_finds_the_levels_by_measured_photons() -> None:
    given = recorded(1.0)
    fit = FitResult(source="memory", cameras={"left": CameraFit(noise=fit_noise(given, "left"))})
    (sheet,) = data_sheets(given, fit)
    (efficiency,) = next(row.values for row in sheet.rows if row.symbol == "η")
    assert efficiency.endswith("(± 0.91 % by the photodiode's calibration)")  # 1.5 % of 0.606
    assert "Spectrograms of the PRNU" in [plot.title for plot in sheet.plots]
    assert any("the photodiode's calibration has a standard uncertainty of 1.5 %" in text for text in sheet.remarks)
