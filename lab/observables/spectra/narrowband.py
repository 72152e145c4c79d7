"""Narrowband light and charts against the maker's sensitivity curves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.observables.charts.patches import Patch, halo_light, patch_covariance, patch_levels
from lab.observables.darks.level import added_dark_dn
from lab.observables.dataset import Study, held_out_of
from lab.observables.flats.linearity import RADIOMETER_STD, UniformLevels
from lab.observables.flats.row_light import ROW_LIGHT, nuisances, row_light_scatter
from lab.observables.observable import LEVEL_REACH, Block, Label, Measurement, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES, acting
from sim.effects.base import Effect, Effects
from sim.point import even_share, wide_contrast
from sim.scene.colorchecker import reflectances
from sim.spectrum import FloatArray, Spectrum, linear_shares
from sim.uniform import LEVEL, SPECTRAL, FieldPoints, Uniform, electron_rate

# Relative prior standard deviations.
LEAK_STD = 2.0e-4  # of the curve's peak, at all wavelengths: sensitivity where the maker states none
#: Sensitivity beyond a curve's ends, of what falls from its last value to 0 where silicon turns transparent (band gap
#: of 1.12 eV) and where glass and oxide turn opaque: any share from none to all, whose root mean square is this.
BEYOND_STD, SILICON_NM, GLASS_NM = 3.0**-0.5, 1107.0, 330.0
CURVE_SCALE_STD = 0.2  # errors of gain, aperture and lens included
LEVEL_STD = 0.5  # of all signals where gain, f-number or pitch aren't known
CURVE_TILT_STD = 0.05  # per 100 nm
CURVE_BEND_STD = 0.01  # per (100 nm)^2
CURVE_ROUGH_STD, CURVE_ROUGH_NM = 0.003, 60.0  # of the smooth errors, and their correlation length
MOST_DECIMALS = 6  # of a curve's values; with fewer, rounding is counted
CURVE_STEP_NM = 2.5  # of a curve that `freed_curve` returns


class CurveJacobian:
    """Electron rates of n pairs of light and channel, and their Jacobian by nuisance parameters of the maker's curves.

    Parameters of a channel: scale, tilt, bend, smooth errors (squared-exponential prior on knots), the unknown course
    between the maker's samples, a leak, and the sensitivity beyond the curve's ends, which only light that lies there
    shows. The derivative of the rate by a factor 1 + d(w) on the curve is the rate with the curve times d(w): exact, as
    the rate is linear in the curve. The baseline's rates are those of `sim.uniform.electron_rate`. Effects enter as
    ratios of sums over 1 nm, in which the sums' discretisation error cancels.
    """

    def __init__(
        self,
        study: Study,
        items: Sequence[tuple[str, str, float, str, Spectrum | None]],
        measured_e_per_s: FloatArray | None = None,
        scale: float = 1.0,
    ) -> None:
        """`items`: n of (path of the radiance, channel, exposure in s, kind of capture, reflectance).
        `measured_e_per_s` (n,): where gain, f-number or pitch aren't known, the rates are scaled to their sum, and the
        common level is a nuisance parameter. `scale`: a factor on all rates."""
        self.study, self.items = study, items
        self.kind = items[0][3]
        lights = {path: study.spectrum(path) for path in {item[0] for item in items}}
        camera = study.camera
        low = min(light.arrays[0][0] for light in lights.values())
        high = max(light.arrays[0][-1] for light in lights.values())
        self.wavelength = np.arange(np.floor(low), np.ceil(high) + 1.0)
        self.radiance = {path: light.at(self.wavelength) for path, light in lights.items()}
        curve = {c: q.at(self.wavelength) for c, q in camera.quantum_efficiency.items()}
        ones = np.ones_like(self.wavelength)
        photons = np.array([self.wavelength * (r.at(self.wavelength) if r is not None else ones) for *_, r in items])
        self._curve = photons * np.array([curve[c] for _, c, *_ in items])
        # the leak: a sensitivity that is the same at all wavelengths
        self._level = photons * np.array([[LEAK_STD * max(camera.quantum_efficiency[c].value)] for _, c, *_ in items])
        beyond = {c: BEYOND_STD * _beyond(q, self.wavelength) for c, q in camera.quantum_efficiency.items()}
        self._beyond = photons * np.array([beyond[c] for _, c, *_ in items])
        radiance = np.array([self.radiance[path] for path, *_ in items])
        self._weight, self._all_level, self._all_beyond = (
            radiance * w for w in (self._curve, self._level, self._beyond)
        )
        self._total = self._weight.sum(1)
        self._rate = np.array(
            [electron_rate(camera, c, lights[path], kind=kind, reflectance=r) for path, c, _, kind, r in items]
        )
        #: Factor on the rates, for the unknown gain, aperture or pixel area.
        self.scale, self._is_free = scale, measured_e_per_s is not None and not study.level_is_known
        if measured_e_per_s is not None and self._is_free:
            self.scale = max(float(measured_e_per_s.sum()), 1e-9) / max(float(self._rate.sum()), 1e-300)
        self._rate = self._rate * self.scale
        self._per_weight = {
            c: max(
                (
                    rate / total
                    for rate, total, item in zip(self._rate, self._total, items, strict=True)
                    if item[1] == c and total > 0
                ),
                default=0.0,
            )
            for c in curve
        }
        self._kept: dict[tuple[Effect, ...], tuple[FloatArray, Callable[[], FloatArray]]] = {}
        self._modes = curve_modes(self.wavelength)
        between = {c: _between_samples(q, self.wavelength) for c, q in camera.quantum_efficiency.items()}
        self._between = np.array([between[c] for _, c, *_ in items])

    @cached_property
    def rounding(self) -> FloatArray:
        """Standard deviation (n,) of the rates, e/s, by the rounding of the curves' values, each independent."""
        found = []
        for i, (path, channel, *_) in enumerate(self.items):
            samples, value = self.study.camera.quantum_efficiency[channel].arrays
            share = self.radiance[path] * self._level[i] / (LEAK_STD * value.max())
            each = linear_shares(self.wavelength, share, samples)
            found.append(
                _last_place(value) / np.sqrt(12.0) * self._per_weight[channel] * float(np.sqrt(np.sum(each**2)))
            )
        return np.array(found)

    @cached_property
    def sample_shares(self) -> FloatArray:
        """Derivatives d ln(rate) / d ln(radiance) of the baseline's rates by the radiance in each nanometre, (n,
        wavelengths). Rows sum to 1."""
        return np.asarray(self._weight / np.maximum(self._total, 1e-300)[:, None])

    def _under(self, effects: Effects) -> tuple[FloatArray, Callable[[], FloatArray]]:
        """Rates (n,), and what computes their derivatives (n, modes) by the modes of the curves, e/s per prior standard
        deviation: of most sets of effects, nobody asks for these."""
        spectral = acting(effects, SPECTRAL)
        if spectral not in self._kept:
            model = Uniform(self.study.camera, spectral)
            weight, *_ = self._weights(spectral, model)
            through = model.transmittance(self.wavelength)
            rate = self._rate * (weight @ through) / np.maximum(self._total, 1e-300)
            if len(self._kept) > 500:
                self._kept.clear()
            self._kept[spectral] = rate, cache(partial(self._derivatives, spectral, model, rate, through))
        return self._kept[spectral]

    def _weights(self, spectral: Effects, model: Uniform) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Light times curve, times the leak, and times the sensitivity beyond the curve, (n, wavelengths) each."""
        if not acting(spectral, frozenset({"light.spectrum"})):
            return self._weight, self._all_level, self._all_beyond
        lit = {path: model.radiance(self.wavelength, r, self.kind) for path, r in self.radiance.items()}
        changed = np.array([lit[path] for path, *_ in self.items])
        return changed * self._curve, changed * self._level, changed * self._beyond

    def _derivatives(self, spectral: Effects, model: Uniform, rate: FloatArray, through: FloatArray) -> FloatArray:
        weight, level, beyond = self._weights(spectral, model)
        table = np.column_stack([weight @ (self._modes * through).T, (weight * self._between) @ through])
        shares = table / np.maximum(weight @ through, 1e-300)[:, None]
        per_weight = np.array([self._per_weight[c] for _, c, *_ in self.items])
        outside = np.column_stack([level @ through, beyond @ through]) * per_weight[:, None]
        return np.column_stack([rate[:, None] * shares, outside])

    def rates(self, effects: Effects) -> FloatArray:
        """Electrons a second on axis, (n,)."""
        return self._under(effects)[0]

    def jacobian(self, effects: Effects) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,) of the rates, e/s per prior standard deviation."""
        table = self._under(effects)[1]()
        named = {}
        for channel in self.study.channels:
            mine = np.array([item[1] == channel for item in self.items])
            if mine.any():
                for i in range(table.shape[1]):
                    named[f"curve:{channel}:{i}"] = np.where(mine, table[:, i], 0.0)
        if self._is_free:
            named[f"level:{self.kind}"] = LEVEL_STD * self.rates(effects)
        return named


def curve_modes(wavelength_nm: FloatArray) -> FloatArray:
    """Relative changes (modes, wavelengths) of a curve by its nuisance parameters, one prior standard deviation each:
    scale, tilt, bend, and the principal components of the smooth errors."""
    knots = np.arange(380.0, 781.0, 20.0)
    cov = CURVE_ROUGH_STD**2 * np.exp(-0.5 * ((knots[:, None] - knots) / CURVE_ROUGH_NM) ** 2)
    size, vector = np.linalg.eigh(cov)
    keep = size > 1e-3 * size.max()
    modes = [
        np.full_like(knots, CURVE_SCALE_STD),
        CURVE_TILT_STD * (knots - 560.0) / 100.0,
        CURVE_BEND_STD * ((knots - 560.0) / 100.0) ** 2,
    ]
    modes += [vector[:, i] * np.sqrt(size[i]) for i in np.flatnonzero(keep)[::-1]]
    return np.array([np.interp(wavelength_nm, knots, mode) for mode in modes])


def freed_curve(curve: Spectrum, channel: str, quantities: Mapping[str, float]) -> Spectrum:
    """Return a maker's curve, corrected by fitted nuisance parameters. `quantities`: names as of
    `CurveJacobian.jacobian`, values in prior standard deviations. The curve itself where none is of this channel.
    Values are limited to 0..1."""
    names = [name for name in quantities if name.startswith(f"curve:{channel}:")]
    if not names:
        return curve
    low, high = curve.wavelength_nm[0], curve.wavelength_nm[-1]
    grid = np.union1d(np.array(curve.wavelength_nm), np.arange(np.ceil(low), high, CURVE_STEP_NM))
    relative = np.vstack([curve_modes(grid), _between_samples(curve, grid)]) * curve.at(grid)
    changes = np.vstack([relative, np.full_like(grid, LEAK_STD * max(curve.value)), np.zeros_like(grid)])
    value = curve.at(grid) + sum(quantities[name] * changes[int(name.rsplit(":", 1)[1])] for name in names)
    return Spectrum.of(grid, np.clip(value, 0.0, 1.0))


def _beyond(curve: Spectrum, wavelength_nm: FloatArray) -> FloatArray:
    """Largest sensitivity beyond a curve's samples: from its value at either end linearly to 0 at `SILICON_NM` and
    `GLASS_NM`; 0 within."""
    (low, *_, high), (first, *_, last) = curve.wavelength_nm, curve.value
    above = last * (SILICON_NM - wavelength_nm) / max(SILICON_NM - high, 1.0)
    below = first * (wavelength_nm - GLASS_NM) / max(low - GLASS_NM, 1.0)
    outside = np.where(wavelength_nm > high, above, np.where(wavelength_nm < low, below, 0.0))
    return np.asarray(np.maximum(outside, 0.0))


def _last_place(value: FloatArray) -> float:
    """Return the unit in the last decimal of a curve's values: 10^-d for d decimals, d <= `MOST_DECIMALS`."""
    for decimals in range(1, MOST_DECIMALS):
        if np.all(np.abs(value * 10**decimals - np.round(value * 10**decimals)) < 1e-3):
            return float(10.0**-decimals)
    return float(10.0**-MOST_DECIMALS)


def _between_samples(curve: Spectrum, wavelength_nm: FloatArray) -> FloatArray:
    """Relative difference of a cubic spline through a curve's samples from linear interpolation, limited to +-0.2.

    A data sheet's samples, 5 nm apart, don't say which is right. At the foot of a colour filter they differ by some per
    cent."""
    if len(curve.wavelength_nm) < 4:
        return np.zeros_like(wavelength_nm)
    straight = curve.at(wavelength_nm)
    spline = CubicSpline(curve.wavelength_nm, curve.value)(wavelength_nm)
    inside = straight > 1e-4 * max(curve.value)
    return np.where(inside, np.clip(spline / np.where(inside, straight, 1.0) - 1.0, -0.2, 0.2), 0.0)


# --- Signals in narrowband light against the maker's sensitivity curves -----------------------------------------------


# Relative standard deviations.
NARROWBAND_FLOOR = 1e-4  # of a level, independent between channels, common to its repeats
READING_SAMPLE_STD = 1e-3  # of a sample of a radiometer's reading, where no wavelength was read twice
MOST_SAMPLE_STD = 4e-3  # the most that is measured of it
READING_STD = 1e-4  # the least of a reading, common to the channels
_READINGS = 8  # readings from which on their standard deviation is measured


def narrowband_block(study: Study) -> Block:
    """Mean of every unclipped narrowband frame by channel, DN, against the maker's sensitivity curves.

    Nuisance parameters: black level, dark current, and smooth errors of the curves (`curves`). Raises NotDetermined
    where the curves aren't stated, and for fewer than four means.
    """
    if not study.stated.quantum_efficiency:
        raise NotDetermined(
            "narrowband", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    captures = study.recordings.captures(NarrowbandCapture, study.side)
    groups = study.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    out = set().union(*(held_out_of(g, i, len(groups)) for i, g in enumerate(groups))) if groups else set()
    points = []
    for capture in captures:
        for channel in study.channels:
            mean = study.levels(capture).mean[channel]
            if mean is not None and channel in study.stated.quantum_efficiency:
                points.append((capture, channel, mean, capture.id in out))
    if len(points) < 4:
        raise NotDetermined("narrowband", "fewer than four unclipped narrowband signals")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([p[2] for p in points])
    noise = study.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 0.0)
    curves = CurveJacobian(
        study,
        [(c.radiance, channel, c.exposure_s, "narrowband", None) for c, channel, *_ in points],
        signal / noise.gain / exposures,
    )
    every = list(dict.fromkeys(c.radiance for c, *_ in points))
    known = [c for c in study.channels if c in study.camera.quantum_efficiency]
    whole = CurveJacobian(
        study, [(path, c, 1.0, "narrowband", None) for path in every for c in known], scale=curves.scale
    )
    covariance = _narrowband_covariance(study, points, signal, curves)

    levels = UniformLevels(study, [(c, channel) for c, channel, *_ in points])
    light_of = np.array([every.index(path) for path in {c.id: c.radiance for c, *_ in points}.values()])

    def jacobian_of(effects: Effects, share: FloatArray) -> dict[str, FloatArray]:
        """Name of a nuisance parameter -> derivative (n,), DN. `share` (n,): DN for an electron a second on axis."""
        jacobian = study.free_offsets(exposures) | study.free_warmth([c for c, *_ in points])
        jacobian |= levels.lines.jacobian(effects)
        return jacobian | {k: v * share for k, v in curves.jacobian(effects).items()}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        if not acting(effects, LEVEL | LAG | DARK_CURRENT):
            # effects on the spectrum alone: signals are proportional to the rates
            share = noise.gain * float(study.field.light.mean()) * exposures
            return Prediction(
                noise.black + noise.dark_dn_per_s * exposures + share * rates, partial(jacobian_of, effects, share)
            )
        lit = whole.rates(effects).reshape(len(every), len(known))[light_of]
        light_dn = levels.of_light_dn(effects, dict(zip(known, lit.T, strict=True)))
        share = (light_dn - noise.dark_dn_per_s * exposures) / np.maximum(rates, 1e-30)
        return Prediction(light_dn + levels.beside_light_dn(effects), partial(jacobian_of, effects, share))

    return Block(
        measurement=NARROWBAND, reach=25.0, value=value, covariance=covariance,
        labels=tuple(Label(c.wavelength_nm, channel, f"{c.wavelength_nm:g} nm", (c.id,), o) for c, channel, _,
        o in points),
        reads=LEVEL | LAG | DARK_CURRENT | SPECTRAL, scattered_by=LINES, predict=predict, scale=np.maximum(signal, 1.0),
    )  # fmt: skip


def _narrowband_covariance(
    study: Study, points: list[tuple[Any, str, float, bool]], signal: FloatArray, curves: CurveJacobian
) -> FloatArray:
    """Covariance (n, n) of narrowband means, DN^2: shot and read noise, floor and rounding (common to repeats), the
    radiometer's readings, and the lamp's repeatability (common to a frame's channels)."""
    noise = study.noise
    exposures = np.array([c.exposure_s for c, *_ in points])
    pixels = np.array([study.levels(c).pixels[channel] for c, channel, *_ in points])
    rounded = curves.rounding * exposures * float(study.field.light.mean()) * noise.gain
    shot = (noise.gain * signal + noise.read_dn**2) / pixels
    frame = np.array([c.id for c, *_ in points])
    setting = np.array([f"{c.wavelength_nm} {c.exposure_s} {channel}" for c, channel, *_ in points])
    reading = np.array([c.radiance for c, *_ in points])
    digits = noise.rounding_std_dn(signal)
    own = np.sqrt((NARROWBAND_FLOOR * signal) ** 2 + rounded**2 + digits**2)
    expected = curves.rates(()) * exposures
    radiometer = signal * _reading_std(points, signal, shot, expected)
    covariance = np.diag(shot) + (setting[:, None] == setting) * np.outer(own, own)
    readings: dict[float, dict[str, Spectrum]] = {}
    for c, *_ in points:
        readings.setdefault(c.wavelength_nm, {})[c.radiance] = study.spectrum(c.radiance)
    sampled = curves.sample_shares * (_sample_std([*r.values()] for r in readings.values()) * signal)[:, None]
    covariance += (reading[:, None] == reading) * (np.outer(radiometer, radiometer) + sampled @ sampled.T)
    lamp = signal * noise.jitter_lamp
    covariance += (frame[:, None] == frame) * (np.outer(lamp, lamp) + noise.jitter_dn**2)
    return np.asarray(covariance)


def _reading_std(points: list[Any], signal: FloatArray, shot: FloatArray, expected: FloatArray) -> float:
    """Relative standard deviation s of a radiometer's readings, common to the channels, from second differences along
    wavelength.

    With u the ln of measured over expected signal at neighbouring wavelengths, u_2 - (u_1 + u_3) / 2 has the variance
    1.5 s^2 + that of the noise. The median of its magnitude isn't moved by a few outlying wavelengths. At most
    `RADIOMETER_STD`, so that structure of the light or of filters isn't taken for noise; that, too, for fewer than
    `_READINGS` readings."""
    deviation: dict[str, tuple[float, float, float]] = {}
    by_frame: dict[str, list[int]] = {}
    for i, (capture, *_) in enumerate(points):
        by_frame.setdefault(capture.id, []).append(i)
    strong = signal > 0.05 * signal.max()
    for frame, members in by_frame.items():
        use = [i for i in members if strong[i] and expected[i] > 0]
        if use:
            weight = np.square(signal[use]) / shot[use]
            ratio = np.log(signal[use] / expected[use])
            place = points[use[0]][0].wavelength_nm
            deviation[frame] = place, float(np.sum(weight * ratio) / weight.sum()), float(1.0 / weight.sum())
    found = sorted(deviation.values())
    if len(found) < _READINGS:
        return RADIOMETER_STD
    u, v = np.array([f[1] for f in found]), np.array([f[2] for f in found])
    bend = u[1:-1] - 0.5 * (u[:-2] + u[2:])
    noise = float(np.median(v[1:-1] + 0.25 * (v[:-2] + v[2:])))
    spread = float(np.median(np.abs(bend))) / 0.6745
    return float(np.sqrt(np.clip((spread**2 - noise) / 1.5, READING_STD**2, RADIOMETER_STD**2)))


def _sample_std(repeats: Iterable[Sequence[Spectrum]]) -> float:
    """Relative standard deviation of a sample of a radiometer's reading, independent of its neighbours. `repeats`: the
    readings of each wavelength.

    Of two readings: the standard deviation of their log ratio over sqrt 2, at samples above a tenth of the peak. The
    median over pairs is taken, at most `MOST_SAMPLE_STD`.
    """
    found = []
    for readings in repeats:
        for first, second in pairwise(readings):
            (w, a), (v, b) = first.arrays, second.arrays
            lit = (a > 0.1 * a.max()) & (b > 0.1 * b.max()) if np.array_equal(w, v) else np.zeros(len(w), bool)
            if lit.sum() > 2:
                found.append(float(np.std(np.log(a[lit] / b[lit]), ddof=1)) / np.sqrt(2.0))
    return min(float(np.median(found)), MOST_SAMPLE_STD) if found else READING_SAMPLE_STD


NARROWBAND = Measurement(
    "narrowband",
    title="signal in narrowband light",
    order=280,
    axis="wavelength",
    unit="nm",
    make=narrowband_block,
    quantity="mean level, DN",
    is_level=True,
)


# ----------------------------------------------------------------------------------------------------------------------
# Mean levels of the patches of a ColorChecker chart, against its published reflectances and the maker's sensitivity
# curves.


#: Prior standard deviation of the light's level on the chart, and of its gradient from the middle to a side of the
#: frame, relative.
CHART_SCALE_STD, CHART_GRADIENT_STD = 0.05, 0.005


def chart_block(study: Study) -> Block:
    """Mean level (DN) of every patch of a ColorChecker24 by channel.

    Nuisance parameters: level and gradient of the light, the maker's sensitivity curves, black level and dark current.
    Tolerances of the reflectances are in the covariance. Raises NotDetermined where the sensitivity curves aren't
    stated, and with fewer than twelve unclipped patches.
    """
    if not study.stated.quantum_efficiency:
        raise NotDetermined(
            "chart", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    points = patch_levels(study)
    if len(points) < 12:
        raise NotDetermined("chart", "fewer than twelve unclipped patches of a ColorChecker24")
    noise, camera = study.noise, study.camera
    value = np.array([p.level for p in points])
    exposures = np.array([p.captures[0].exposure_s for p in points])
    row, col = np.array([p.row for p in points]), np.array([p.col for p in points])
    tail = np.array([p.tail for p in points])
    offset = noise.black + noise.dark_dn_per_s * exposures
    signal = np.maximum(value - offset, 0.1)
    surround = np.array([p.frame for p in points]) - offset  # the mean light, of which a veil adds a share
    place = FieldPoints.at(camera, row, col)
    known = reflectances(points[0].captures[0].chart)
    curves = CurveJacobian(
        study,
        [(p.captures[0].radiance, p.channel, p.captures[0].exposure_s, "chart", known[p.name]) for p in points],
        signal / noise.gain / exposures,
    )
    names = {n: i for i, n in enumerate(known)}

    of_channel = {name: np.array([p.channel == name for p in points]) for name in study.channels}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        model = Uniform(camera, effects)
        time = np.array([model.collected_s(float(t)) for t in exposures])
        ambient = np.array([model.ambient_e(p.channel, float(t)) for p, t in zip(points, exposures, strict=True)])
        electrons = rates * model.field(place).light * (time + model.leaked_s(place))
        if model.strays:
            electrons = _strayed(points, electrons, place, model)
        electrons = electrons * _mixing(study, points, electrons, model)
        veil = even_share(camera, effects) * surround + halo_light([p.around for p in points], effects, camera)
        electrons = wide_contrast(camera, effects) * electrons + (veil + tail) / noise.gain + ambient
        more = added_dark_dn(study, effects)
        dark = noise.dark_dn_per_s * exposures + np.array([more(p.captures[0]) for p in points])
        read_dn = np.empty(len(points))
        for name, mine in of_channel.items():
            read_dn[mine] = model.mean_dn({name: (electrons + dark / noise.gain)[mine, None]})[name]
        lit = read_dn - dark
        offset = study.offset(effects)
        shift = np.array([offset(p.captures[0]) for p in points])

        def jacobian() -> dict[str, FloatArray]:
            found = study.free_offsets(exposures) | study.free_warmth([p.captures[0] for p in points])
            found |= {k: v * lit / np.maximum(rates, 1e-30) for k, v in curves.jacobian(effects).items()}
            found["chart:scale"] = CHART_SCALE_STD * lit
            found["chart:x"] = CHART_GRADIENT_STD * lit * (col / camera.cols - 0.5) * 2
            found["chart:y"] = CHART_GRADIENT_STD * lit * (row / camera.rows - 0.5) * 2
            found |= _row_light(points, model, camera.rows, lit)
            return found

        return Prediction(noise.black + read_dn + shift, jacobian)

    return Block(
        measurement=CHART,
        reach=LEVEL_REACH,
        along=np.log(np.maximum(signal, 1.0)),
        value=value,
        covariance=patch_covariance(study, points, signal),
        labels=tuple(
            Label(float(names[p.name]), p.channel, p.name, tuple(c.id for c in p.captures), p.held_out) for p in points
        ),
        reads=(LEVEL - {"light.level"}) | SPECTRAL | DARK_CURRENT | {"image.veils"},
        scattered_by=ROW_LIGHT,
        predict=predict,
        scale=signal,
    )


def _row_light(points: list[Patch], model: Uniform, rows: int, lit: FloatArray) -> dict[str, FloatArray]:
    """Jacobian of the patches' levels by a light that varies while a frame is taken, of each capture's frames at
    once."""
    by_capture: dict[tuple[ChartCapture, ...], list[int]] = {}
    for i, p in enumerate(points):
        by_capture.setdefault(p.captures, []).append(i)
    vectors = []
    for captures, members in by_capture.items():
        at = np.clip(np.round([points[i].row for i in members]).astype(int), 0, rows - 1)
        exposure_s = captures[0].exposure_s
        for one in row_light_scatter(model, rows, exposure_s, len(captures), partial(np.take, indices=at, axis=1)):
            whole = np.zeros(len(points))
            whole[members] = one * lit[members]
            vectors.append(whole)
    return nuisances("chart", vectors)


def _strayed(points: list[Patch], electrons: FloatArray, place: FieldPoints, model: Uniform) -> FloatArray:
    """Return the patches' electrons (n,) after light that misses its pixel fell on the next ones."""
    found = np.empty(len(points))
    for members in _by_patch(points):
        where = [*members.values()]
        there = FieldPoints(*(v[where] for v in (place.x_um, place.y_um, place.light)))
        after = model.stray_light({c: electrons[i] * np.ones(len(where)) for c, i in members.items()}, there)
        for k, (c, i) in enumerate(members.items()):
            found[i] = after[c][k]
    return found


def _by_patch(points: list[Patch]) -> list[dict[str, int]]:
    """Return the index of each channel, of every patch of every capture."""
    found: dict[tuple[str, str], dict[str, int]] = {}
    for i, p in enumerate(points):
        found.setdefault((p.captures[0].id, p.name), {})[p.channel] = i
    return [*found.values()]


def _mixing(study: Study, points: list[Patch], electrons: FloatArray, model: Uniform) -> FloatArray:
    """Factors (n,) on the patches' electrons by effects that move charge between neighbouring pixels of different
    channels."""
    factor = np.ones(len(points))
    for members in _by_patch(points):
        if len(members) == len(study.channels):
            mixed = model.mixing_factors({c: float(electrons[i]) for c, i in members.items()})
            for c, i in members.items():
                factor[i] = mixed.get(c, 1.0)
    return factor


CHART = Measurement(
    "chart",
    title="patches of the chart",
    order=300,
    axis="level",
    unit="DN",
    make=chart_block,
    quantity="mean level, DN",
    is_level=True,
    places="patches",
)
