"""Captures that a station or a person could take next, each with the forward model's prediction of it and its
covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lab.capture.plan import CapturePlan
from lab.capture_kinds.dark import DarkCapture, DarkSequence
from lab.capture_kinds.flat import FlatSequence
from lab.capture_kinds.narrowband import NarrowbandSequence
from lab.capture_kinds.slanted_edge import EdgeSequence
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.measurements.curves import CURVE_ROUGH_STD
from lab.diagnose.measurements.narrowband import NARROWBAND_FLOOR
from lab.diagnose.outcome.settling_capture import FEW_REPEATS, MORE_REPEATS, repeats_of
from lab.formats.recording_set import RecordingSet
from lab.measure.noise_figures import BLACK_FLOOR_DN
from lab.measure.repeatability import LAMP_FLOOR
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.point import optical_transfer
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import FieldPoints, Uniform, electron_rate

#: Size of a capture that is assumed: pixels of a channel, repeats, and the brightest channel's electrons over the full
#: well.
PIXELS, REPEATS, FILLED = 2e4, 4, 0.6
#: Standard deviations that don't average out: of a variance, relative, beside its noise; of a transfer function, where
#: no edge tells.
VARIANCE_STD, EDGE_STD = 0.003, 0.004
#: Prior standard deviation of a level that is a nuisance parameter, relative: so wide that it says nothing.
NUISANCE_STD = 10.0
#: Length of a session (s), over which drifts show.
SESSION_S = 3600.0


@dataclass(frozen=True)
class Hypothesis:
    """A rival with the effects that act beside it, and the camera with its nuisance parameters at their posterior
    means."""

    name: str
    effects: tuple[Effect, ...]
    camera: CameraModel


@dataclass(frozen=True)
class CandidateCapture:
    """A capture that could be taken."""

    words: str
    predict: Callable[[Hypothesis], FloatArray]  # (n,): its numbers under a hypothesis
    covariance: FloatArray  # (n, n)
    plan: CapturePlan | None = None  # the sequence that takes it; None: a station can't by itself


def candidate_captures(recordings: RecordingSet, side: Side, model: MeasurementModel) -> Iterator[CandidateCapture]:
    """All captures that are considered, in order: narrowband, edges, flats, darks, and those of the session again."""
    camera = model.camera
    lamp = _lamp(recordings, side)
    yield from _narrowband(camera)
    yield from _edges(camera, model, lamp)
    yield from _exposure_series(camera, lamp)
    yield from _steady(camera, lamp)
    yield from _darks(camera)
    yield from _again(recordings, side, model)


def _lamp(recordings: RecordingSet, side: Side) -> Spectrum:
    """The light of the flats or the chart, else of equal energy."""
    for kind in ("flat", "chart"):
        for capture in recordings.captures(kind, side):
            path = getattr(capture, "radiance", None)
            if path is not None:
                return recordings.spectrum(path)
    return Spectrum.of((380.0, 780.0), (0.01, 0.01))


def _filling_exposure_s(camera: CameraModel, light: Spectrum, kind: str = "flat") -> float:
    """Exposure (s) that fills the brightest channel to `FILLED` of the full well; 0 where no channel sees the light."""
    brightest = max(electron_rate(camera, c, light, (), kind) for c in camera.channels)
    return FILLED * camera.full_well_e / brightest if brightest > 0 else 0.0


def _means(h: Hypothesis, light: Spectrum, kind: str, exposure_s: float, elapsed_s: float = 0.0) -> dict[str, float]:
    """Mean electrons of uniform light by channel, after the read-out."""
    rates = {c: electron_rate(h.camera, c, light, h.effects, kind) for c in h.camera.channels}
    model = Uniform(h.camera, h.effects)
    field = model.field(FieldPoints.of(h.camera))
    collected = model.electrons(rates, exposure_s, field=field, elapsed_s=elapsed_s)
    gain = h.camera.conversion_gain_dn_per_e
    return {c: float(value) / gain for c, value in model.mean_dn(collected).items()}


def _narrowband(camera: CameraModel) -> Iterator[CandidateCapture]:
    """Light of one wavelength, every 5 nm."""
    for centre in np.arange(400.0, 721.0, 5.0):
        light = Spectrum.of((centre - 10.0, centre, centre + 10.0), (0.0, 1e-3, 0.0))
        exposure = _filling_exposure_s(camera, light, "narrowband")
        if exposure <= 0:
            continue

        def predict(h: Hypothesis, light: Spectrum = light, exposure: float = exposure) -> FloatArray:
            return np.array(list(_means(h, light, "narrowband", exposure).values()))

        signal = predict(Hypothesis("", (), camera))
        noise = (signal + camera.read_noise_e**2) / (PIXELS * REPEATS)
        floor = np.square(signal) * (NARROWBAND_FLOOR**2 + CURVE_ROUGH_STD**2)
        around = {"from_nm": float(centre - 5.0), "to_nm": float(centre + 5.0), "step_nm": 2.5}
        yield CandidateCapture(
            f"narrowband light at {centre:g} nm",
            predict,
            np.diag(noise + floor + (BLACK_FLOOR_DN / camera.conversion_gain_dn_per_e) ** 2),
            CapturePlan((NarrowbandSequence.model_validate(around),)),
        )


def _edges(camera: CameraModel, model: MeasurementModel, lamp: Spectrum) -> Iterator[CandidateCapture]:
    """Slanted edges: at four orientations, in the lamp's and in narrowband light, at the lens's and at twice its
    f-number."""
    frequency = np.arange(1, 17) * 0.05
    block = next((b for b in model.blocks if b.measurement.name == "slanted_edge"), None)
    std = np.full(frequency.shape, EDGE_STD)
    if block is not None:  # the smallest standard deviation of any recorded edge at each frequency
        x, variance = np.array([label.x for label in block.labels]), np.diag(block.covariance)
        places = np.unique(x)
        std = np.interp(frequency, places, [float(np.sqrt(variance[x == place].min())) for place in places])
    angles = np.deg2rad([5.0, 50.0, 95.0, 140.0])
    fx, fy = np.outer(np.cos(angles), frequency), np.outer(np.sin(angles), frequency)
    lights = {"the lamp's light": lamp} | {
        f"light of {nm:g} nm": Spectrum.of((nm - 10.0, nm, nm + 10.0), (0.0, 1e-3, 0.0)) for nm in (450.0, 550.0, 650.0)
    }
    for stops, at in ((1.0, ""), (2.0, " at twice the f-number")):
        for name, light in lights.items():
            channels_lit = [c for c in camera.channels if electron_rate(camera, c, light) > 0]

            def predict(
                h: Hypothesis, stops: float = stops, light: Spectrum = light, channels: list[str] = channels_lit
            ) -> FloatArray:
                lens = h.camera.lens.model_copy(update={"f_number": stops * h.camera.lens.f_number})
                stopped = h.camera.model_copy(update={"lens": lens})
                return np.concatenate(
                    [np.real(optical_transfer(stopped, c, light, fx, fy, h.effects)).ravel() for c in channels]
                )

            n = len(channels_lit) * fx.size
            is_usual = stops == 1.0 and light is lamp
            plan = CapturePlan((EdgeSequence(frames=2 * REPEATS),)) if is_usual else None
            if n:
                words = f"slanted edges at 5, 50, 95 and 140 degrees in {name}{at}"
                yield CandidateCapture(words, predict, np.diag(np.square(np.tile(std, n // len(std)))), plan)


def _exposure_series(camera: CameraModel, lamp: Spectrum) -> Iterator[CandidateCapture]:
    """Flats at many levels: by the exposure, or by the light at one exposure. Means and variances. Nuisance parameters:
    gain, read noise, black level, and the light in each channel."""
    shares = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92]) / FILLED
    full = _filling_exposure_s(camera, lamp)
    if full <= 0:
        return
    dimmed = [Spectrum.of(*(lamp.arrays[0], share * lamp.arrays[1])) for share in shares]
    series = {
        "flats at ten exposures, from 1 to 92 % of the full well": [(lamp, share * full) for share in shares],
        "flats at one exposure and ten levels of the light, from 1 to 92 % of the full well": [
            (d, full) for d in dimmed
        ],
    }
    for words, steps in series.items():

        def predict(h: Hypothesis, steps: list[tuple[Spectrum, float]] = steps) -> FloatArray:
            levels = [list(_means(h, light, "flat", seconds).values()) for light, seconds in steps]
            mean = np.array(levels).T.ravel()
            variance = Uniform(h.camera, h.effects).shot_e2(mean) + h.camera.read_noise_e**2
            return np.concatenate([mean, variance])

        mean, variance = np.split(predict(Hypothesis("", (), camera)), 2)
        std = np.concatenate(
            [
                np.hypot(np.sqrt(variance / (PIXELS * REPEATS)), 2.0 * LAMP_FLOOR * mean),
                np.hypot(np.sqrt(2.0 / (PIXELS * (REPEATS - 1))), VARIANCE_STD) * variance,
            ]
        )
        covariance = np.diag(np.square(std))
        zero = np.zeros_like(mean)
        jacobian = [np.concatenate([zero, mean]), np.concatenate([zero, np.ones_like(mean)])]  # gain and read noise
        jacobian += [np.concatenate([np.ones_like(mean), zero])]  # black level
        for channel in np.split(np.arange(len(mean)), len(camera.channels)):  # the light
            rate = np.zeros(2 * len(mean))
            rate[channel] = mean[channel]
            jacobian.append(rate)
        covariance += NUISANCE_STD**2 * sum(np.outer(column, column) for column in jacobian)
        by_exposure = all(light is lamp for light, _ in steps)
        sequence = FlatSequence(levels=tuple((FILLED * shares).round(3).tolist()), frames=2 * REPEATS)
        yield CandidateCapture(words, predict, covariance, CapturePlan((sequence,)) if by_exposure else None)


def _steady(camera: CameraModel, lamp: Spectrum) -> Iterator[CandidateCapture]:
    """The same flat, repeated over an hour. The lamp's level is a nuisance parameter, its change with time isn't."""
    full = _filling_exposure_s(camera, lamp)
    times = np.linspace(0.0, SESSION_S, 13)
    if full <= 0:
        return

    def predict(h: Hypothesis) -> FloatArray:
        return np.array([list(_means(h, lamp, "flat", full, float(t)).values()) for t in times]).T.ravel()

    mean = predict(Hypothesis("", (), camera))
    noise = (mean + camera.read_noise_e**2) / (PIXELS * REPEATS)
    levels = np.kron(np.eye(len(camera.channels)), np.ones((len(times), len(times)))) * np.outer(mean, mean)
    yield CandidateCapture(
        "the same flat every five minutes for an hour",
        predict,
        np.diag(noise + np.square(2.0 * LAMP_FLOOR * mean)) + NUISANCE_STD**2 * levels,
    )


def _darks(camera: CameraModel) -> Iterator[CandidateCapture]:
    """Dark frames by exposure, by time and by temperature; black level and dark current are nuisance parameters."""
    gain, reference = camera.conversion_gain_dn_per_e, camera.dark_current_reference_c
    times = np.linspace(0.0, SESSION_S, 13)
    series = {
        "dark frames every five minutes for an hour": [(0.01, t, reference) for t in times],
        "dark frames with the sensor 10 and 20 degrees warmer": [
            (s, 0.0, reference + c) for c in (0, 10, 20) for s in (0.01, 1.0, 5.0)
        ],
        "dark frames from 1 ms to 20 s": [(s, 0.0, reference) for s in np.geomspace(0.001, 20.0, 10)],
    }
    for words, steps in series.items():

        def predict(h: Hypothesis, steps: list[tuple[float, float, float]] = steps) -> FloatArray:
            found = []
            for seconds, elapsed, temperature in steps:
                model = Uniform(h.camera, h.effects)
                dark = float(np.mean(model.dark_e_per_s(temperature))) + model.mean_hot_e_per_s
                found.append(dark * seconds * gain + model.offset_dn(elapsed, temperature))
            return np.array(found)

        seconds = np.array([s for s, _, _ in steps])
        covariance = np.eye(len(steps)) * (2 * BLACK_FLOOR_DN) ** 2
        covariance += NUISANCE_STD**2 * (np.ones_like(covariance) + np.outer(seconds, seconds))
        exposures = "from 1 ms" in words
        plan = CapturePlan((DarkSequence(exposures_s=tuple(seconds.round(4).tolist()), frames=REPEATS),))
        yield CandidateCapture(words, predict, covariance, plan if exposures else None)


def _again(recordings: RecordingSet, side: Side, model: MeasurementModel) -> Iterator[CandidateCapture]:
    """Every measurement again with the same captures. Those of dark frames with few repeats get more, which reduces
    their covariance."""
    darks = {c.id: c for c in recordings.captures(DarkCapture, side)}
    repeats = repeats_of(darks.values())
    for block, at in zip(model.blocks, model.slices, strict=True):

        def predict(h: Hypothesis, at: slice = at) -> FloatArray:
            return model.fitted_mean(tuple(e for e in h.effects if e not in model.always))[at]

        title = block.measurement.title
        names = {name for label in block.labels for name in label.captures}
        if 0 < repeats < FEW_REPEATS and names <= set(darks):
            exposures = tuple(sorted({darks[name].exposure_s for name in names if darks[name].exposure_s > 0}))
            plan = CapturePlan((DarkSequence(exposures_s=exposures, frames=MORE_REPEATS),)) if exposures else None
            words = f"the dark frames of {title} again, {MORE_REPEATS} at each setting in place of {repeats}"
            yield CandidateCapture(words, predict, block.covariance * repeats / MORE_REPEATS, plan)
        else:
            yield CandidateCapture(f"the captures of {title} again, with as many repeats", predict, block.covariance)
