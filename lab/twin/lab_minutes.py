"""Rank the sequences of a station by the reduction of an application's uncertainty per minute of lab time.

Each sequence that the station can take measures numbers y = y(z) + noise of covariance S, J = dy / dz at the model.
After it, the parameters' covariance V is (Rasmussen and Williams 2006, eq. 2.26)

    V' = V - V J' (J V J' + S)^-1 J V
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lab.capture.catalogue import StepTimes, estimate
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.station import Station
from lab.capture_kinds.base import Sequence
from lab.capture_kinds.chart import ChartSequence
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.capture_kinds.slanted_edge import EdgeSequence, EdgeTarget
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import FirstEstimates
from lab.observables.charts.chart import CHART_SCALE_STD
from lab.observables.charts.patches import reflectance_covariance
from lab.observables.flats.noise import VARIANCE_FLOOR
from lab.observables.noise.figures import BLACK_FLOOR_DN
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.camera import CameraModel
from sim.point import optical_transfer
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import FieldPoints, Uniform, electron_rate

#: The light of flats, chart and edges: of equal energy. Its level drops out, as exposures are found.
LIGHT = Spectrum.of((380.0, 780.0), (0.01, 0.01))
#: Spatial frequencies (cy/px) of an edge, and the standard deviation of its transfer function in one frame.
FREQUENCY, EDGE_STD = np.arange(1, 11) * 0.05, 0.004
#: Highest level, share of the full well, that is counted; width (nm) of the light of a monochromator.
HIGHEST_LEVEL, LINE_NM = 0.95, 10.0


@dataclass(frozen=True)
class LabCapture:
    """A sequence that could be taken: its numbers (n,) by a model, and the covariance (n, n) of their noise."""

    words: str
    minutes: float
    is_learned: bool
    captures: int
    numbers: Callable[[CameraFile], FloatArray]
    covariance: FloatArray

    def update_covariance(self, covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
        """Return the covariance (k, k) of the parameters after the capture, for the Jacobian (n, k) of its numbers."""
        known = jacobian @ covariance
        total = cho_factor(known @ jacobian.T + self.covariance, lower=True)
        return np.asarray(covariance - known.T @ cho_solve(total, known))


def lab_captures(
    content: CameraFile, first: FirstEstimates, station: Station, times: StepTimes
) -> Iterator[LabCapture]:
    """Yield every sequence of the station whose numbers the model predicts, as a full and as a quick session has it."""
    seen: set[str] = set()
    for is_quick in (False, True):
        for sequence in full_plan(station, is_quick).sequences:
            key = sequence.model_dump_json()
            make = NUMBERS.get(type(sequence))
            if make is None or key in seen:
                continue
            seen.add(key)
            made = make(content, first, sequence, station)
            planned = estimate(CapturePlan((sequence,)), station, times)
            yield LabCapture(
                words=f"{sequence.name}, {planned.captures} captures" + (" (quick)" if is_quick else ""),
                minutes=planned.estimated_s / 60.0,
                is_learned=all(sequence_time.learned for sequence_time in planned.sequences),
                captures=planned.captures,
                numbers=made[0],
                covariance=made[1],
            )


Made = tuple[Callable[[CameraFile], FloatArray], FloatArray]


def _darks(content: CameraFile, first: FirstEstimates, sequence: DarkSequence, station: Station) -> Made:
    """Mean (DN) at every exposure, and the variance (DN^2) at the shortest."""
    exposures = np.array(sequence.exposures_s)

    def numbers(changed: CameraFile) -> FloatArray:
        camera, model = changed.camera, Uniform(changed.camera, changed.effects)
        dark_e = float(np.mean(model.dark_e_per_s(camera.dark_current_reference_c))) * exposures
        gain = camera.conversion_gain_dn_per_e
        return np.append(camera.black_level_dn + gain * dark_e, gain**2 * (dark_e[0] + camera.read_noise_e**2))

    base = numbers(content)
    pixels, gain = content.camera.rows * content.camera.cols, content.camera.conversion_gain_dn_per_e
    pixel_dn2 = gain * np.maximum(base[:-1] - content.camera.black_level_dn, 0.0) + first.read_noise_dn**2
    jitter = max(first.level_jitter_dn, BLACK_FLOOR_DN)
    mean = pixel_dn2 / (pixels * sequence.frames) + jitter**2 / sequence.frames + BLACK_FLOOR_DN**2
    return numbers, np.diag(np.append(mean, _variance_dn4(base[-1:], pixels, sequence.frames)))


def _flats(content: CameraFile, first: FirstEstimates, sequence: FlatSequence, station: Station) -> Made:
    """Mean (DN) of every level below saturation by channel, and its temporal variance (DN^2)."""
    camera = content.camera
    shares = np.array([level for level in sequence.levels if level < HIGHEST_LEVEL])
    line = sequence.wavelength_nm
    light = _line(line) if line else LIGHT
    exposures = shares * camera.full_well_e / _brightest(camera, light)
    signal = _levels(content, [(light, "flat", float(t), None) for t in exposures])

    def numbers(changed: CameraFile) -> FloatArray:
        levels = _levels(changed, [(light, "flat", float(t), None) for t in exposures])
        gain, model = changed.camera.conversion_gain_dn_per_e, Uniform(changed.camera, changed.effects)
        # the variance at the signal that is measured, not at that of a changed model
        shot = gain**2 * (model.shot_e2(signal / gain) + changed.camera.read_noise_e**2)
        return np.concatenate([levels, shot])

    _, variance = np.split(numbers(content), 2)
    pixels = camera.rows * camera.cols / len(camera.channels)
    mean = variance / (pixels * sequence.frames) + np.square(first.lamp_jitter * signal) / sequence.frames
    covariance = np.diag(np.concatenate([mean, _variance_dn4(variance, pixels, sequence.frames)]))
    covariance[: len(signal), : len(signal)] += RADIOMETER_STD**2 * np.outer(signal, signal)
    return numbers, covariance


def _narrowband(content: CameraFile, first: FirstEstimates, sequence: NarrowbandSequence, station: Station) -> Made:
    """Mean (DN) of every channel at every wavelength, at one exposure each."""
    camera = content.camera
    lights = [_line(nm) for nm in sequence.wavelengths_nm]
    brightest = [_brightest(camera, light) for light in lights]
    items = [
        (light, "narrowband", sequence.level * camera.full_well_e / rate, None)
        for light, rate in zip(lights, brightest, strict=True)
        if rate > 0.0
    ]

    def numbers(changed: CameraFile) -> FloatArray:
        return _levels(changed, items)

    signal = numbers(content)
    pixels = camera.rows * camera.cols / len(camera.channels) * sequence.passes
    noise = (camera.conversion_gain_dn_per_e * signal + first.read_noise_dn**2) / pixels + BLACK_FLOOR_DN**2
    each = np.kron(np.ones((len(camera.channels),) * 2), np.eye(len(items)))  # one reading a wavelength
    return numbers, np.diag(noise) + RADIOMETER_STD**2 * each * np.outer(signal, signal)


def _chart(content: CameraFile, first: FirstEstimates, sequence: ChartSequence, station: Station) -> Made:
    """Mean level (DN) of every patch by channel."""
    camera, known = content.camera, reflectances("ColorChecker24")
    exposure_s = sequence.level * camera.full_well_e / _brightest(camera, LIGHT)
    items = [(LIGHT, "chart", exposure_s, patch) for patch in known.values()]

    def numbers(changed: CameraFile) -> FloatArray:
        return _levels(changed, items)

    signal = numbers(content)
    names = np.array([name for _ in camera.channels for name in known])
    channel = np.array([c for c in camera.channels for _ in known])
    pixels = camera.rows * camera.cols / len(camera.channels) / (2.0 * len(known)) * sequence.frames
    noise = (camera.conversion_gain_dn_per_e * signal + first.read_noise_dn**2) / pixels
    light = CHART_SCALE_STD**2 * np.outer(signal, signal)
    return numbers, np.diag(noise) + reflectance_covariance(names, channel, signal) + light


def _edges(content: CameraFile, first: FirstEstimates, sequence: EdgeSequence, station: Station) -> Made:
    """MTF of every edge of the station on the axis, by channel."""
    angles = np.deg2rad([edge.angle_deg for edge in station.list_targets(EdgeTarget).values()])
    fx, fy = np.outer(np.cos(angles), FREQUENCY), np.outer(np.sin(angles), FREQUENCY)

    def numbers(changed: CameraFile) -> FloatArray:
        camera = changed.camera
        contrasts = [np.real(optical_transfer(camera, c, LIGHT, fx, fy, changed.effects)) for c in camera.channels]
        return np.array(contrasts).ravel()

    return numbers, np.eye(fx.size * len(content.camera.channels)) * EDGE_STD**2 / sequence.frames


#: What the numbers of a sequence are, and their covariance.
NUMBERS: dict[type[Sequence], Callable[..., Made]] = {
    DarkSequence: _darks,
    FlatSequence: _flats,
    NarrowbandSequence: _narrowband,
    ChartSequence: _chart,
    EdgeSequence: _edges,
}


def _line(centre_nm: float) -> Spectrum:
    return Spectrum.of((centre_nm - LINE_NM, centre_nm, centre_nm + LINE_NM), (0.0, 1e-3, 0.0))


def _brightest(camera: CameraModel, light: Spectrum) -> float:
    return max(electron_rate(camera, c, light) for c in camera.channels)


def _levels(content: CameraFile, items: Iterable[tuple[Spectrum, str, float, Spectrum | None]]) -> FloatArray:
    """Levels above black (DN), channel by channel, of (light, kind of capture, exposure in s, reflectance)."""
    camera, model = content.camera, Uniform(content.camera, content.effects)
    field = model.field(FieldPoints.of(camera))
    levels = []
    for light, kind, exposure_s, patch in items:
        rates = {c: electron_rate(camera, c, light, content.effects, kind, reflectance=patch) for c in camera.channels}
        levels.append([float(v) for v in model.mean_dn(model.electrons(rates, exposure_s, field=field)).values()])
    return np.array(levels).T.ravel()


def _variance_dn4(variance_dn2: FloatArray, pixels: float, frames: int) -> FloatArray:
    """Variance (DN^4) of temporal variances (DN^2); without repeats they aren't measured."""
    relative = 2.0 / (pixels * (frames - 1)) + VARIANCE_FLOOR**2 if frames > 1 else 1e6
    return relative * np.square(variance_dn2)
