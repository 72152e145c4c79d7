"""A drawn camera and its session: size, gain, levels and repeats vary from set to set."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.third_party.models import SimulatedOptics, SimulatedSensor
from lab.formats.recording_set import Manifest, RecordingSet
from sim.sensor.margins import NO_MARGINS
from sim.spectrum import FloatArray, Spectrum

BLACK_DN, WHITE_DN = 100.0, 4095.0
WAVELENGTH_NM, F_NUMBER = 550.0, 8.0
#: Share of saturation that the brightest flat reaches.
BRIGHTEST = 0.9
EDGE_PX = 96
START = datetime(2026, 3, 2, 9, tzinfo=UTC)


@dataclass(frozen=True)
class DrawnCamera:
    """A monochrome camera of 12 bits. `prnu`, `dsnu_e` (rows, cols): factors on light, electrons in the dark."""

    rows: int
    cols: int
    pitch_um: float
    gain_dn_per_e: float
    read_noise_e: float
    dark_e_per_s: float
    prnu: FloatArray
    dsnu_e: FloatArray

    @property
    def full_well_e(self) -> float:
        """Return the electrons of the highest code."""
        return (WHITE_DN - BLACK_DN) / self.gain_dn_per_e

    def convert(self, signal_e: FloatArray, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return codes (rows, cols) of signals in electrons: read noise, gain, black level, rounding."""
        noisy = signal_e + self.read_noise_e * rng.standard_normal(signal_e.shape)
        return np.clip(np.rint(BLACK_DN + self.gain_dn_per_e * noisy), 0, WHITE_DN).astype(np.uint16)


def draw_camera(rng: np.random.Generator) -> DrawnCamera:
    """Draw a camera's size, pitch, gain, noise and dark current."""
    rows, cols = ((96, 128), (128, 160), (160, 160))[int(rng.integers(3))]
    return DrawnCamera(
        rows=rows,
        cols=cols,
        pitch_um=float(rng.choice([3.45, 5.0, 10.0])),
        gain_dn_per_e=float(rng.uniform(0.25, 0.8)),
        read_noise_e=float(rng.uniform(2.0, 5.0)),
        dark_e_per_s=float(rng.uniform(2.0, 10.0)),
        prnu=1.0 + 0.008 * rng.standard_normal((rows, cols)),
        dsnu_e=0.8 * rng.standard_normal((rows, cols)),
    )


@dataclass
class _ThirdPartySession:
    """Captures and frames in the order in which they are taken."""

    camera: DrawnCamera
    captures: list[dict[str, Any]]
    frames: dict[str, NDArray[np.uint16]]
    time_s: float = 0.0

    def add(self, kind: str, signal: NDArray[np.uint16], exposure_s: float, **keys: Any) -> None:
        name = f"c{len(self.captures):03d}"
        time = (START + timedelta(seconds=self.time_s)).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        self.frames[f"frames/{name}.npy"] = signal
        self.captures.append(
            {"id": name, "kind": kind, "side": "left", "frame": f"frames/{name}.npy", "exposure_s": exposure_s,
             "temperature_c": 20.0, "time": time} | keys
        )  # fmt: skip
        self.time_s += exposure_s

    def recordings(self, name: str, spectra: dict[str, Spectrum], **camera: Any) -> RecordingSet:
        sheet = {
            "rows": self.camera.rows, "cols": self.camera.cols, "pixel_pitch_um": self.camera.pitch_um,
            "fill_factor": 1.0, "cfa": "MONO", "bit_depth": 12, "black_level_dn": BLACK_DN, "white_level_dn": WHITE_DN,
        }  # fmt: skip
        text = {"name": name, "cameras": {"left": sheet | camera}, "captures": self.captures}
        manifest = Manifest.model_validate(Manifest.model_validate(text).model_dump(mode="json"))
        return RecordingSet(manifest, dict(self.frames), spectra, {}, source=name)


def record_sensor(name: str, camera: DrawnCamera, sensor: SimulatedSensor, rng: np.random.Generator) -> RecordingSet:
    """Take darks at three exposures and flats at eight to eleven levels, three to six of each; hot pixels, dark frames
    after the bright ones, or faint flats where the sensor's plan has them."""
    session = _ThirdPartySession(camera, [], {})
    repeats, levels = int(rng.integers(4, 7)), int(rng.integers(8, 12))
    dark_e_per_s = np.full((camera.rows, camera.cols), camera.dark_e_per_s)
    if sensor.plan == "hot pixels":
        hot = rng.random(dark_e_per_s.shape) < 0.006
        dark_e_per_s = dark_e_per_s + hot * (100.0 + rng.exponential(400.0, hot.shape))

    def expose(kind: str, light_e: float, exposure_s: float, **keys: Any) -> None:
        mean_e = light_e * camera.prnu + dark_e_per_s * exposure_s
        dsnu_e = sensor.margins.surround(camera.dsnu_e)
        signal_e = sensor.read(sensor.collect(mean_e, exposure_s, rng), rng) + dsnu_e
        session.add(kind, camera.convert(signal_e, rng), exposure_s, **keys)

    for exposure_s in (0.05, 2.0, 4.0):
        for _ in range(max(repeats, 5)):
            expose("dark", 0.0, exposure_s)
    shares = np.linspace(0.04, BRIGHTEST, levels)
    faint = np.array([0.01, 0.02]) if sensor.plan == "faint flats" else np.zeros(0)
    step_s = 0.1 if sensor.plan == "dark after bright" else 0.05
    for share in (*faint, *shares):
        light_e = float(share * camera.full_well_e)
        for _ in range(24 if share in faint else repeats):
            expose("flat", light_e, float(10.0 * share * step_s), photons_per_pixel=2.0 * light_e,
                   wavelength_nm=WAVELENGTH_NM)  # fmt: skip
    if sensor.plan == "dark after bright":
        for _ in range(9):
            expose("dark", 0.0, 4.0)
    stated = {} if sensor.margins == NO_MARGINS else {"margins": sensor.margins.model_dump()}
    return session.recordings(name, {}, **stated)


def record_optics(name: str, camera: DrawnCamera, optics: SimulatedOptics, rng: np.random.Generator) -> RecordingSet:
    """Take darks, flats, and slanted edges along rows and columns under light of 550 nm, through a lens at f/8 of 400
    mm, by which light falls off by less than 0.1 %."""
    session = _ThirdPartySession(camera, [], {})
    rows, cols = camera.rows, camera.cols

    def expose(kind: str, light_e: FloatArray, exposure_s: float, **keys: Any) -> None:
        mean_e = light_e * camera.prnu + camera.dark_e_per_s * exposure_s
        signal_e = rng.poisson(np.maximum(mean_e, 0.0)) + camera.dsnu_e
        session.add(kind, camera.convert(signal_e, rng), exposure_s, **keys)

    for exposure_s in (0.05, 2.0, 4.0):
        for _ in range(5):
            expose("dark", np.zeros((rows, cols)), exposure_s)
    for share in (0.1, 0.3, 0.5, 0.7, 0.85):
        light_e = share * camera.full_well_e
        for _ in range(4):
            expose("flat", np.full((rows, cols), light_e), 0.5 * share, photons_per_pixel=2.0 * light_e,
                   wavelength_nm=WAVELENGTH_NM)  # fmt: skip
    size = min(rows, cols, EDGE_PX)
    top, left = (rows - size) // 2, (cols - size) // 2
    tilt = float(rng.uniform(4.0, 8.0))
    for angle_deg in (tilt, 90.0 - tilt, tilt - 90.0, -tilt):
        part = optics.edge(size, angle_deg, camera.pitch_um)
        whole = np.full((rows, cols), 0.5)
        whole[top : top + size, left : left + size] = part
        for _ in range(4):
            expose("slanted_edge", camera.full_well_e * (0.08 + 0.72 * whole), 0.1, angle_deg=angle_deg,
                   region=[top, left, top + size, left + size], field_mm=[0.0, 0.0],
                   dark_radiance="spectra/dark.csv", light_radiance="spectra/light.csv")  # fmt: skip
    wavelength_nm = np.arange(WAVELENGTH_NM - 3.0, WAVELENGTH_NM + 4.0)
    lamp = np.maximum(1.0 - np.abs(wavelength_nm - WAVELENGTH_NM) / 2.0, 0.0)
    spectra = {
        "spectra/light.csv": Spectrum.of(wavelength_nm, 0.8 * lamp),
        "spectra/dark.csv": Spectrum.of(wavelength_nm, 0.08 * lamp),
        "spectra/qe.csv": Spectrum.of(np.array([400.0, 700.0]), np.array([0.5, 0.5])),
    }
    return session.recordings(
        name, spectra, f_number=F_NUMBER, focal_length_mm=400.0, quantum_efficiency={"Y": "spectra/qe.csv"}
    )
