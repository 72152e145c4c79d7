"""The mean of dark frames by exposure, temperature and time; and the measured black level against the stated one."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from lab.capture_kinds.base import Capture
from lab.errors import NotDetermined
from lab.observables.codes.rounding import QUANTISATION_DN2
from lab.observables.darks.frames import DarkStatistics, conditions, dark_frames
from lab.observables.dataset import Study
from lab.observables.noise.figures import BLACK_FLOOR_DN, STATED_BLACK_DN, STATED_BLACK_SHARE
from lab.observables.noise.line_means import LineMeans
from lab.observables.observable import Block, Label, Measurement, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES
from sim.effects.base import Effects
from sim.spectrum import FloatArray
from sim.uniform import Uniform, noise_values

#: Most points of the grid on which the dark current over the field is evaluated. A grid much coarser than the pixels
#: moves the laws' origin and the cells' borders: with 50 DN of glow in a corner, a cell's mean is then off by a hundred
#: standard deviations.
MOST_POINTS = 1e6


def dark_current_map(study: Study, effects: Effects) -> Callable[[float | None], FloatArray]:
    """Function of the temperature (C) that returns the dark current (rows, cols), e/s: by pixel, or by squares of
    pixels where the frame has more than `MOST_POINTS` pixels."""
    camera = study.camera
    down = math.ceil(math.sqrt(camera.rows * camera.cols / MOST_POINTS))
    coarse = camera.model_copy(
        update={
            "rows": camera.rows // down,
            "cols": camera.cols // down,
            "pixel_pitch_um": camera.pixel_pitch_um * down,
        }
    )
    return Uniform(coarse, effects).dark_e_per_s


def added_dark_e_per_s(study: Study, effects: Effects) -> Callable[[float | None], float]:
    """Function of the temperature (C) that returns the change of the mean dark current by effects, without defective
    pixels, e/s."""
    if not Uniform(study.camera, effects).changes_dark_current:
        return lambda temperature_c: 0.0
    at = dark_current_map(study, effects)
    return cache(lambda temperature_c: float(at(temperature_c).mean()) - study.camera.dark_current_e_per_s)


def added_dark_dn(study: Study, effects: Effects) -> Callable[[Capture], float]:
    """Function of a capture that returns the change of its mean dark signal by effects, DN."""
    rate_at = added_dark_e_per_s(study, effects)
    return lambda capture: study.noise.gain * rate_at(capture.temperature_c) * capture.exposure_s


def dark_level_block(study: Study) -> Block:
    """Mean of every dark frame without defective pixels, DN.

    Nuisance parameters: black level and dark current. Effects may add an offset that drifts with time or temperature,
    dark current, image lag, and the converter's error at these codes. Raises NotDetermined without dark captures."""
    frames = study.once(dark_frames)
    captures = [(c, f.condition, c in f.condition.held_out) for f in frames for c in f.condition.captures]
    value = np.array([f.means[c.id] for f in frames for c in f.condition.captures])
    exposures = np.array([c.exposure_s for c, *_ in captures])
    noise, gain = study.noise, study.noise.gain
    base = noise.black + noise.dark_dn_per_s * exposures
    lines = LineMeans(study, [(c, None) for c, *_ in captures])

    def predict(effects: Effects) -> Prediction:
        offset, more, carried = study.offset(effects), added_dark_dn(study, effects), study.carried_mean_e(effects)
        mean = base.copy()
        for i, (capture, _, _) in enumerate(captures):
            mean[i] += offset(capture) + more(capture) + gain * carried(capture)
        model = Uniform(study.camera, effects)
        if not model.has_even_codes:
            mean = model.codes(mean[:, None] + gain * study.camera.read_noise_e * noise_values(1)).mean(axis=1)
        return Prediction(mean, study.free_offsets(exposures) | lines.jacobian(effects))

    # noise of less than about half a code doesn't dither: rounding moves the mean, by its place between two codes
    coarse = np.array([_rounding_dn(f, noise.step_dn) for f in frames for _ in f.condition.captures])
    floor_dn = BLACK_FLOOR_DN * noise.step_dn
    same = np.array([[a[1] is b[1] for b in captures] for a in captures])
    # the coordinate of smoothness: 10 degrees count as twice the range of exposures
    reach = float(max(np.ptp(exposures), 1e-3))
    warmer = np.array(
        [
            0.0 if k.temperature_c is None or noise.dark_c is None else k.temperature_c - noise.dark_c
            for _, k, _ in captures
        ]
    )
    return Block(
        measurement=DARK, reach=reach, value=value, along=exposures + 2.0 * reach * warmer / 10.0,
        covariance=(noise.dark_jitter_dn**2 + floor_dn**2) * np.eye(len(value)) + same * np.outer(coarse, coarse),
        labels=tuple(Label(c.exposure_s, "all", k.name, (c.id,), out) for c, k, out in captures),
        reads=LAG | DARK_CURRENT | {"signal.offset_dn", "signal.exposure_offset_dn", "codes.codes"},
        scattered_by=LINES, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def _rounding_dn(frames: DarkStatistics, step_dn: float) -> float:
    """Largest shift of a mean by rounding to `step_dn`, DN: exp(-2 pi^2 variance) / pi of the step, with the variance
    before rounding in its squares."""
    changing = next((c.variance_dn2 for c in frames.changing.values()), None)
    if changing is None:
        return 0.1 * step_dn
    bare = max(changing / step_dn**2 - QUANTISATION_DN2, 0.0)
    return float(step_dn * np.exp(-2.0 * np.pi**2 * bare) / np.pi)


def black_level_block(study: Study) -> Block:
    """Return the measured black level against the stated one, DN. No effect changes it: a wrong statement is no effect.

    Raises NotDetermined where none is stated.
    """
    stated = study.stated.black_level_dn
    if stated is None:
        raise NotDetermined("black_level", "the black level isn't stated: nothing to hold the dark frames against")
    shortest = min(conditions(study), key=lambda c: c.exposure_s)
    std = float(np.hypot(STATED_BLACK_SHARE * stated, STATED_BLACK_DN)) + study.noise.black_std
    return Block(
        measurement=BLACK_LEVEL, reach=1.0, value=np.array([study.noise.black]),
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
    make=dark_level_block,
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
    make=black_level_block,
    quantity="black level, DN",
)
