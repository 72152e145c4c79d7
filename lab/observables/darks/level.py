"""The mean of dark frames by exposure, temperature and time; and the measured black level against the stated one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from lab.capture_kinds.base import Capture
from lab.errors import NotDetermined
from lab.observables.codes.rounding import rounding_waves_dn
from lab.observables.darks.frames import conditions, dark_frames, spread_dn2
from lab.observables.dataset import Dataset
from lab.observables.noise.figures import STATED_BLACK_DN, STATED_BLACK_SHARE
from lab.observables.noise.line_means import LineMeans
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform, noise_values

#: Most points of the grid on which the dark current over the field is evaluated. A grid much coarser than the pixels
#: moves the laws' origin and the cells' borders: with 50 DN of glow in a corner, a cell's mean is then off by a hundred
#: standard deviations.
MOST_POINTS = 1e6


def dark_current_map(dataset: Dataset, effects: Effects) -> Callable[[float | None], FloatArray]:
    """Function of the temperature (C) that returns the dark current (rows, cols), e/s: by pixel, or by squares of
    pixels where the frame has more than `MOST_POINTS` pixels."""
    camera = dataset.camera
    down = math.ceil(math.sqrt(camera.rows * camera.cols / MOST_POINTS))
    coarse = camera.model_copy(
        update={
            "rows": camera.rows // down,
            "cols": camera.cols // down,
            "pixel_pitch_um": camera.pixel_pitch_um * down,
        }
    )
    return Uniform(coarse, effects).dark_e_per_s


def added_dark_e_per_s(dataset: Dataset, effects: Effects) -> Callable[[float | None], float]:
    """Function of the temperature (C) that returns the change of the mean dark current by effects, without defective
    pixels, e/s."""
    if not Uniform(dataset.camera, effects).changes_dark_current:
        return lambda temperature_c: 0.0
    at = dark_current_map(dataset, effects)
    return cache(lambda temperature_c: float(at(temperature_c).mean()) - dataset.camera.dark_current_e_per_s)


def added_dark_dn(dataset: Dataset, effects: Effects) -> Callable[[Capture], float]:
    """Function of a capture that returns the change of its mean dark signal by effects, DN."""
    rate_at = added_dark_e_per_s(dataset, effects)
    return lambda capture: dataset.noise.gain * rate_at(capture.temperature_c) * capture.exposure_s


def measure_dark(dataset: Dataset) -> Observable:
    """Mean of every dark frame without defective pixels, DN.

    Nuisance parameters: black level and dark current. Effects may add an offset that drifts with time or temperature,
    dark current, image lag, and the converter's error at these codes. Raises NotDetermined without dark captures, and
    where most pixels are at code 0."""
    frames = dataset.once(dark_frames)
    captures = [(c, f.condition, c in f.condition.held_out) for f in frames for c in f.condition.captures]
    value = np.array([f.means[c.id] for f in frames for c in f.condition.captures])
    exposures = np.array([c.exposure_s for c, *_ in captures])
    noise, gain = dataset.noise, dataset.noise.gain
    if value.min() < 0.5 * noise.step_dn:
        raise NotDetermined(
            "dark",
            f"dark frames have a mean of {value.min():.2g} DN: most pixels are at code 0, and their mean doesn't "
            "follow the signal; raise the black level until few pixels are at code 0",
        )
    base = noise.black + noise.dark_dn_per_s * exposures
    lines = LineMeans(dataset, [(c, None) for c, *_ in captures])

    def predict(effects: Effects) -> Prediction:
        offset, more, carried = (
            dataset.offset(effects),
            added_dark_dn(dataset, effects),
            dataset.carried_mean_e(effects),
        )
        mean = base.copy()
        for i, (capture, _, _) in enumerate(captures):
            mean[i] += offset(capture) + more(capture) + gain * carried(capture)
        model = Uniform(dataset.camera, effects)
        if not model.has_even_codes:
            mean = model.codes(mean[:, None] + gain * dataset.camera.read_noise_e * noise_values(1)).mean(axis=1)
        return Prediction(mean, dataset.free_offsets(exposures) | lines.jacobian(effects))

    # noise of less than about half a code doesn't dither: rounding moves the mean, by its place between two codes
    spread = np.repeat(spread_dn2(frames, noise.step_dn), [len(f.condition.captures) for f in frames])
    waves = np.reshape(rounding_waves_dn(base, spread, noise.step_dn), (-1, len(value)))
    # where no frame is repeated, by the read noise that is taken elsewhere
    pixels = dataset.camera.rows * dataset.camera.cols
    usual_dn2 = (noise.read_dn**2 + noise.gain * noise.dark_dn_per_s * exposures) / pixels
    own_dn2 = np.array([f.mean_dn2[c.id] for f in frames for c in f.condition.captures])
    own_dn2 = np.where(np.isfinite(own_dn2), own_dn2, usual_dn2)
    # the coordinate of smoothness: 10 degrees count as twice the range of exposures
    reach = float(max(np.ptp(exposures), 1e-3))
    warmer = np.array(
        [
            0.0 if k.temperature_c is None or noise.dark_c is None else k.temperature_c - noise.dark_c
            for _, k, _ in captures
        ]
    )
    return Observable(
        measurement=DARK, reach=reach, value=value, along=exposures + 2.0 * reach * warmer / 10.0,
        covariance=np.diag(own_dn2 + noise.white_jitter_dn**2) + waves.T @ waves,
        labels=tuple(Label(c.exposure_s, "all", k.name, (c.id,), out) for c, k, out in captures),
        reads=LAG | DARK_CURRENT | {"signal.offset_dn", "signal.exposure_offset_dn", "codes.codes"},
        scattered_by=LINES, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def measure_black_level(dataset: Dataset) -> Observable:
    """Return the measured black level against the stated one, DN. No effect changes it: a wrong statement is no effect.

    Raises NotDetermined where none is stated.
    """
    stated = dataset.stated.black_level_dn
    if stated is None:
        raise NotDetermined("black_level", "the black level isn't stated: nothing to hold the dark frames against")
    shortest = min(conditions(dataset), key=lambda c: c.exposure_s)
    std = float(np.hypot(STATED_BLACK_SHARE * stated, STATED_BLACK_DN)) + dataset.noise.black_std
    return Observable(
        measurement=BLACK_LEVEL, reach=1.0, value=np.array([dataset.noise.black]),
        covariance=np.array([[std**2]]),
        labels=(Label(0.0, "all", "stated level", tuple(c.id for c in shortest.captures), False),),
        reads=frozenset(), predict=lambda effects: Prediction(np.array([stated]), {}), scale=np.array([max(stated,
        1.0)]),
    )  # fmt: skip


DARK = Measurement(
    "dark",
    title="mean level of dark frames",
    order=100,
    axis="exposure",
    unit="s",
    make=measure_dark,
    quantity="mean level, DN",
    is_level=True,
    conditions="exposure and temperature",
)


BLACK_LEVEL = Measurement(
    "black_level",
    title="black level against the stated one",
    order=110,
    axis="exposure",
    unit="s",
    make=measure_black_level,
    quantity="black level, DN",
)
