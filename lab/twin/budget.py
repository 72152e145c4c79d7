"""Which parameters, as well as they are known at present, matter for a stated use of the camera.

g = d use / d z at the model, by differences; the variance of the use is g' V g with V the posterior covariance. What a
group k of parameters adds is what knowing it exactly would take away (linear propagation, conditional covariance):

    added_k = c_k' V_kk c_k,   c_k = V_kk^-1 V_k g

An error z_k of the group is an error c_k' z_k of the use, with all that goes along with it.

With a station, each sequence that it can take is ranked by what it would take away from the use's standard deviation
for a minute of lab time (`lab.twin.lab_minutes`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lab.capture.catalogue import StepTimes
from lab.capture.station import Station
from lab.diagnose.outcome.model_posterior import STEP, coordinate_name, with_unnamed
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.model_posterior import ModelPosterior
from lab.inference.coordinates import coordinates, moved
from lab.observables.flats.noise import GAIN_STD, READ_STD
from lab.observables.spectra.curves import freed_curve
from lab.one_blas_thread import one_blas_thread
from lab.twin.lab_minutes import LabCapture, lab_captures
from lab.twin.predict import posterior_of
from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.parameters import Frozen
from sim.point import optical_transfer
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import FieldPoints, Uniform, electron_rate

#: The light of all uses, of equal energy, and how far it fills the brightest channel.
LIGHT, FILLED = Spectrum.of((380.0, 780.0), (0.01, 0.01)), 0.7
#: Relative standard deviation of a dark's variance beside chance: rounding, pixels that blink.
DARK_VARIANCE_FLOOR = 0.01
FREQUENCY = np.linspace(0.0, 1.0, 101)  # cy/px
Effects = tuple[Effect, ...]


class Contribution(Frozen):
    """What one effect, or one part of the camera, adds to the variance of a use: its share, and the standard deviation,
    per cent of the use, that its own uncertainty makes."""

    name: str
    parameters: tuple[str, ...]
    share_percent: float
    std_percent: float


class CaptureGain(Frozen):
    """What a sequence of the station would make of a use's standard deviation. `is_learned`: its time rests on
    sessions of this station; else it is that of typical instruments."""

    sequence: str
    minutes: float
    is_learned: bool
    std_percent: float
    reduced_percent: float  # of the use, that the standard deviation falls by
    reduced_percent_per_minute: float


class UseBudget(Frozen):
    """One use: its standard deviation (per cent, rms over its numbers), the contributions, largest first, and the
    sequences of a station, the one first that reduces it most for a minute."""

    use: str
    std_percent: float
    contributions: tuple[Contribution, ...]
    captures: tuple[CaptureGain, ...] = ()


class BudgetResult(Frozen):
    """The result of `calibench twin budget`."""

    model: str
    uses: tuple[UseBudget, ...]


def _exposure_s(camera: CameraModel) -> float:
    return FILLED * camera.full_well_e / max(electron_rate(camera, c, LIGHT) for c in camera.channels)


def _mtf50(camera: CameraModel, effects: Effects, exposure_s: float) -> FloatArray:
    """MTF50, cy/px, along rows and columns by channel."""
    mtf50 = []
    for channel in camera.channels:
        for fx, fy in ((FREQUENCY, 0.0 * FREQUENCY), (0.0 * FREQUENCY, FREQUENCY)):
            mtf = np.abs(optical_transfer(camera, channel, LIGHT, fx, fy, effects))
            below = int(np.argmax(mtf < 0.5)) or len(FREQUENCY) - 1
            mtf50.append(np.interp(-0.5, -mtf[below - 1 : below + 1], FREQUENCY[below - 1 : below + 1]))
    return np.array(mtf50)


def _patches(camera: CameraModel, effects: Effects, exposure_s: float) -> FloatArray:
    """Levels above black, DN, of the chart's patches by channel."""
    model = Uniform(camera, effects)
    field = model.field(FieldPoints.of(camera))
    levels_dn: list[float] = []
    for patch in reflectances("ColorChecker24").values():
        rates = {c: electron_rate(camera, c, LIGHT, effects, "chart", reflectance=patch) for c in camera.channels}
        levels_dn += [float(v) for v in model.mean_dn(model.electrons(rates, exposure_s, field=field)).values()]
    return np.array(levels_dn)


def _variance(camera: CameraModel, effects: Effects, exposure_s: float) -> FloatArray:
    """Temporal variance, DN^2, at five signals of the dark to `FILLED` of the full well."""
    signal = np.linspace(0.0, FILLED, 5) * camera.full_well_e
    return np.asarray(
        camera.conversion_gain_dn_per_e**2 * (Uniform(camera, effects).shot_e2(signal) + camera.read_noise_e**2)
    )


def _dark_mean(camera: CameraModel, effects: Effects, exposure_s: float) -> FloatArray:
    """Dark signal of one second, DN, at the reference temperature and ten degrees above it."""
    model, reference_c = Uniform(camera, effects), camera.dark_current_reference_c
    rates = [float(np.mean(model.dark_e_per_s(reference_c + rise))) for rise in (0.0, 10.0)]
    return camera.conversion_gain_dn_per_e * np.array(rates)


#: What a camera is used for: name -> its numbers.
USES: dict[str, Callable[[CameraModel, Effects, float], FloatArray]] = {
    "MTF50": _mtf50,
    "patches": _patches,
    "variance": _variance,
    "dark mean": _dark_mean,
}


def parse_uses(text: str) -> tuple[str, ...]:
    """Return the uses that a list names, each once.

    text : names with commas between, in any case

    Raises InputError for one that isn't known.

    >>> parse_uses("mtf50")
    ('MTF50',)
    """
    names = {name.lower(): name for name in USES}
    uses = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [part for part in uses if part.lower() not in names]
    if unknown or not uses:
        raise InputError(
            f"--use {text!r}: {unknown[0] if unknown else 'nothing'} isn't a use; take some of {', '.join(USES)}"
        )
    return tuple(dict.fromkeys(names[part.lower()] for part in uses))


@one_blas_thread
def budget(
    content: CameraFile, uses: tuple[str, ...], station: Station | None = None, times: StepTimes | None = None
) -> BudgetResult:
    """Return the budget of every use: the contributions of effects and parameters to the variance of its numbers.

    content : a camera model with uncertainties
    uses : names of `USES`
    station : whose sequences are weighed by what each would reduce
    times : how long the station's steps took, where that is known

    Raises InputError where the model states no uncertainties.
    """
    posterior = with_darks(posterior_of(content), content.camera)
    content = replace(content, effects=with_unnamed(content.effects, posterior))
    covariance = np.array(posterior.covariance)
    after = []
    for capture in (
        lab_captures(content, posterior.first, station, times or StepTimes({})) if station is not None else ()
    ):
        jacobian = _slopes(content, posterior, capture.numbers(content), capture.numbers).T
        after.append((capture, capture.update_covariance(covariance, jacobian)))
    return BudgetResult(model=content.name, uses=tuple(_use(content, posterior, use, after) for use in uses))


def with_darks(posterior: ModelPosterior, camera: CameraModel) -> ModelPosterior:
    """Return a posterior to which dark frames add their read noise: a diagnosis knows that by the photon
    transfer's intercept alone. Two frames of N pixels measure the dark's variance to sqrt(2 / N), and to
    `DARK_VARIANCE_FLOOR`."""
    if "read" not in posterior.names:
        return posterior
    at = posterior.names.index("read")
    covariance, mean = np.array(posterior.covariance), np.array(posterior.mean)
    std = np.hypot(np.sqrt(2.0 / (camera.rows * camera.cols)), DARK_VARIANCE_FLOOR) / READ_STD
    gained = covariance[at] / (covariance[at, at] + std**2)
    return ModelPosterior.of(
        posterior.first, posterior.names, mean - gained * mean[at], covariance - np.outer(gained, covariance[at])
    )


def _slopes(
    content: CameraFile, posterior: ModelPosterior, base: FloatArray, numbers: Callable[[CameraFile], FloatArray]
) -> FloatArray:
    """Derivatives (k, n) of n numbers, `base` at the model, by the k parameters of the posterior."""
    return np.array([_slope(content, posterior, name, base, numbers) for name in posterior.names])


def _relative_std(gradient: FloatArray, covariance: FloatArray) -> float:
    """Standard deviation of a use, rms over its m numbers, by their relative gradient (k, m)."""
    return float(np.sqrt(max(np.mean(np.einsum("km,kl,lm->m", gradient, covariance, gradient)), 0.0)))


@dataclass(frozen=True)
class LinearUse:
    """The numbers (m,) of a use as linear in k parameters: their relative `gradient` (k, m), and the parameters'
    `covariance` (k, k)."""

    names: tuple[str, ...]
    gradient: FloatArray
    covariance: FloatArray

    @property
    def std(self) -> float:
        """Relative standard deviation, rms over the numbers."""
        return _relative_std(self.gradient, self.covariance)

    def groups(self) -> dict[str, list[int]]:
        """Return the indices of the parameters that the use knows, by effect or part of the camera."""
        indices: dict[str, list[int]] = {}
        for i, name in enumerate(self.names):
            if self.gradient[i].any():
                indices.setdefault(_group(name), []).append(i)
        return indices

    def propagate_errors(self, members: list[int]) -> FloatArray:
        """Return c (q, m): errors z (q,) of these parameters are relative errors z c of the use, with all that goes
        along with them."""
        inside = np.linalg.pinv(self.covariance[np.ix_(members, members)], hermitian=True)
        return np.asarray(inside @ self.covariance[members] @ self.gradient)


def linear_use(content: CameraFile, posterior: ModelPosterior, use: str) -> LinearUse:
    """Return a use of the camera about its model; `content` has the effects that the posterior knows
    (`with_unnamed`)."""
    exposure_s = _exposure_s(content.camera)

    def numbers(changed: CameraFile) -> FloatArray:
        return USES[use](changed.camera, changed.effects, exposure_s)

    base = numbers(content)
    slopes = _slopes(content, posterior, base, numbers) / np.maximum(np.abs(base), 1e-12)
    return LinearUse(posterior.names, slopes, np.array(posterior.covariance))


def _use(
    content: CameraFile, posterior: ModelPosterior, use: str, after: list[tuple[LabCapture, FloatArray]]
) -> UseBudget:
    linear = linear_use(content, posterior, use)
    covariance = linear.covariance
    gradient, std = linear.gradient, linear.std
    contributions = []
    for name, members in linear.groups().items():
        inside = covariance[np.ix_(members, members)]
        added = _relative_std(linear.propagate_errors(members), inside) ** 2
        contributions.append(
            Contribution(
                name=name, parameters=tuple(posterior.names[i] for i in members),
                share_percent=100.0 * added / std**2 if std > 0 else 0.0,
                std_percent=100.0 * _relative_std(gradient[members], inside),
            )
        )  # fmt: skip
    contributions.sort(key=lambda contribution: -contribution.share_percent)
    gains = []
    for capture, known in after:
        then = _relative_std(gradient, known)
        gains.append(
            CaptureGain(
                sequence=capture.words, minutes=capture.minutes, is_learned=capture.is_learned,
                std_percent=100.0 * then,
                reduced_percent=100.0 * (std - then),
                reduced_percent_per_minute=100.0 * (std - then) / max(capture.minutes, 1e-3),
            )
        )  # fmt: skip
    gains.sort(key=lambda gain: -gain.reduced_percent_per_minute)
    return UseBudget(use=use, std_percent=100.0 * std, contributions=tuple(contributions), captures=tuple(gains))


def _group(name: str) -> str:
    """Return the effect, or the part of the camera, that a parameter belongs to."""
    kind, _, rest = name.partition(":")
    return f"sensitivity {rest[0]}" if kind == "curve" else name.partition(".")[0]


def _slope(
    content: CameraFile,
    posterior: ModelPosterior,
    name: str,
    base: FloatArray,
    numbers: Callable[[CameraFile], FloatArray],
) -> FloatArray:
    """Derivative (m,) of a use's numbers by one parameter of the posterior; 0 where the use doesn't know it."""
    camera, effects, first = content.camera, content.effects, posterior.first
    coords = {coordinate_name(effects, c): c for c in coordinates(effects, camera)}
    update: dict[str, object] = {}
    step = 0.1
    if name in coords:
        c = coords[name]
        value = float(getattr(effects[c.index], c.name))
        high = c.bounds[1]
        step = max(STEP * c.typical(value), c.quantity.smooth_over)
        step = step if c.to_u(value) + step <= high else -step
        acting = moved(effects, [c], np.array([c.to_u(value) + step]))
        return (numbers(CameraFile(content.name, camera, acting)) - base) / step
    if name.startswith("curve:"):
        channel = name.split(":")[1]
        # the same resampling on both sides, so that the difference is the parameter's alone
        ends = [freed_curve(camera.quantum_efficiency[channel], channel, {name: at}) for at in (0.0, step)]
        values = []
        for end in ends:
            curves = camera.quantum_efficiency | {channel: end}
            values.append(
                numbers(CameraFile(content.name, camera.model_copy(update={"quantum_efficiency": curves}), effects))
            )
        return np.asarray((values[1] - values[0]) / step)
    gain = camera.conversion_gain_dn_per_e
    if name == "gain":
        update["conversion_gain_dn_per_e"] = gain * (1.0 + GAIN_STD * step)
        # electrons times gain are measured: the curves are about that product
        curves = {
            c: Spectrum.of(q.wavelength_nm, np.array(q.value) / (1.0 + GAIN_STD * step))
            for c, q in camera.quantum_efficiency.items()
        }
        update["quantum_efficiency"] = curves
    elif name == "read":
        update["read_noise_e"] = camera.read_noise_e * np.sqrt(1.0 + READ_STD * step)
    elif name == "black":
        update["black_level_dn"] = camera.black_level_dn + step * first.black_level_std_dn
    elif name == "dark":
        update["dark_current_e_per_s"] = camera.dark_current_e_per_s + step * first.dark_current_std_dn_per_s / gain
    else:
        return np.zeros_like(base)
    return np.asarray((numbers(CameraFile(content.name, camera.model_copy(update=update), effects)) - base) / step)
