"""A diagnosis on a few measurements only, of the second former's cameras and of `sim`'s: quick enough for the everyday
suite."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from lab.diagnose.inference.decide import Verdict, decide
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import Manifest, RecordingSet
from lab.observables.dataset import Dataset
from lab.observables.gaussian import chi2
from lab.observables.observable import Measurement, Observable
from sim.camera import CameraModel, Cfa, Lens
from sim.effects.base import Effect
from sim.frame import Exposure, sample
from sim.scene.scenes import Darkness, UniformField
from sim.sensor.margins import NO_MARGINS, Margins
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

UNIFORM = ("dark", "flat", "narrowband")
WAVELENGTH = np.arange(380.0, 781.0)


def declared(name: str, axis: str, unit: str, *, conditions: str = "", places: str = "") -> Measurement:
    """The declaration of a measurement whose numbers a test makes up."""

    def make(dataset: Dataset) -> Observable:
        raise NotImplementedError(f"{name}: a test makes its numbers")

    return Measurement(name, name, 0, axis, unit, make, "made up", conditions=conditions, places=places)


def former(
    seed: int, *laws: Law, cfa: str = "MONO", kinds: tuple[str, ...] = ("dark", "flat"), shuttle: bool = False
) -> RecordingSet:
    """A small session of the second image former."""
    return recordings_of(ConcealedCamera(seed, laws, cfa=cfa, rows=96, cols=128), Plan(kinds, shuttle=shuttle))


def dataset(recordings: RecordingSet) -> Dataset:
    return Dataset(recordings, "left", camera_model(recordings, "left", None, maker_curves=True))


def measured_model(recordings: RecordingSet, *makers: Callable[[Dataset], Observable]) -> MeasurementModel:
    looked_at = dataset(recordings)
    return MeasurementModel(tuple(make(looked_at) for make in makers), looked_at.camera)


def verdict(recordings: RecordingSet, *makers: Callable[[Dataset], Observable]) -> Verdict:
    return decide(measured_model(recordings, *makers), np.random.default_rng(0), DecisionPolicy())


def names(found: Verdict) -> list[str]:
    return [c.effect.name for c in found.named]


def sigmas(found: MeasurementModel, effects: Sequence[Effect] = ()) -> float:
    """How far chi2 of all numbers under the baseline with `effects` lies from their count, in its standard
    deviations."""
    gaussian = found.gaussian(tuple(effects))
    n = len(found.value)
    return (chi2(found.value - gaussian.mean, gaussian.covariance) - n) / float(np.sqrt(2.0 * n))


def rendered(
    seed: int,
    effects: Sequence[Effect] = (),
    *,
    sweep_to_nm: int = 0,
    repeats: int = 3,
    cfa: Cfa = "MONO",
    margins: Margins = NO_MARGINS,
) -> RecordingSet:
    """A session that `sim` takes: darks, flats at eight levels, a sweep from 400 nm where `sweep_to_nm` says how
    far. `margins`: of its frames."""
    wavelength = np.arange(380.0, max(781.0, sweep_to_nm + 41.0))
    curves = {"Y": (540.0, 140.0)} if cfa == "MONO" else {"R": (610.0, 40.0), "G": (540.0, 40.0), "B": (460.0, 35.0)}
    efficiency = {
        channel: Spectrum.of(wavelength, 0.5 * np.exp(-0.5 * ((wavelength - middle) / width) ** 2))
        for channel, (middle, width) in curves.items()
    }
    camera = CameraModel(
        rows=96, cols=128, pixel_pitch_um=3.0, fill_factor=0.9, cfa=cfa, bit_depth=12, black_level_dn=128.0,
        white_level_dn=4095.0,
        conversion_gain_dn_per_e=0.4, full_well_e=9900.0, read_noise_e=3.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
        prnu_percent=0.0,
        quantum_efficiency=efficiency, lens=Lens(f_number=4.0, focal_length_mm=8.0),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    frames: dict[str, np.ndarray] = {}
    spectra = {f"qe-{channel}.csv": curve for channel, curve in efficiency.items()}
    captures: list[dict[str, object]] = []

    def take(kind: str, light: Spectrum | None, exposure_s: float, count: int, **more: object) -> None:
        scene = Darkness() if light is None else UniformField(light, kind)
        for _ in range(count):
            k = len(captures)
            frames[f"{k}.npy"] = sample(
                camera, Exposure(scene, exposure_s, elapsed_s=20.0137 * k), rng, effects, margins=margins
            )
            when = datetime(2026, 3, 2, tzinfo=UTC) + timedelta(seconds=20.0137 * k)
            captures.append(
                {
                    "id": f"c{k}",
                    "kind": kind,
                    "side": "left",
                    "frame": f"{k}.npy",
                    "exposure_s": exposure_s,
                    "time": when,
                    **more,
                }
            )

    for t in (0.001, 0.5, 2.0):
        take("dark", None, t, 3)
    lamp = Spectrum.of(wavelength, np.full(wavelength.shape, 0.02))
    spectra["lamp.csv"] = lamp
    full_s = camera.full_well_e / max(electron_rate(camera, channel, lamp) for channel in camera.channels)
    for level in (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.92):
        take("flat", lamp, round(level * full_s, 7), repeats, radiance="lamp.csv")
    for w in range(400, sweep_to_nm + 1, 10):
        line = Spectrum.of(wavelength, 0.004 * np.exp(-0.5 * ((wavelength - w) / 4.2466) ** 2))
        spectra[f"{w}.csv"] = line
        fastest = max(electron_rate(camera, channel, line) for channel in camera.channels)
        exposure = 0.7 * camera.full_well_e / max(fastest, 1e4)
        take("narrowband", line, round(exposure, 6), 1, wavelength_nm=w, bandwidth_nm=10, radiance=f"{w}.csv")
    stated = {
        "rows": 96, "cols": 128, "pixel_pitch_um": 3.0, "fill_factor": 0.9, "cfa": cfa, "bit_depth": 12,
        "black_level_dn": 128.0,
        "white_level_dn": 4095.0, "f_number": 4.0, "focal_length_mm": 8.0, "lens_transmittance": 1.0,
        "quantum_efficiency": {channel: f"qe-{channel}.csv" for channel in efficiency},
        "margins": margins,
    }  # fmt: skip
    manifest = Manifest.model_validate({"name": "sim", "cameras": {"left": stated}, "captures": captures})
    return RecordingSet(manifest, frames, spectra, source="sim")
