"""The maker's sensitivity curves: rates of electrons in lights of known spectra, and their Jacobian by what may be
wrong with the curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property, partial

import numpy as np
from scipy.interpolate import CubicSpline

from lab.observables.dataset import Dataset
from lab.observables.reads import acting
from sim.effects.base import Effect, Effects
from sim.spectrum import FloatArray, Spectrum, linear_shares
from sim.uniform import SPECTRAL, Uniform, electron_rate

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
        dataset: Dataset,
        items: Sequence[tuple[str, str, float, str, Spectrum | None]],
        measured_e_per_s: FloatArray | None = None,
        scale: float = 1.0,
    ) -> None:
        """`items`: n of (path of the radiance, channel, exposure in s, kind of capture, reflectance).
        `measured_e_per_s` (n,): where gain, f-number or pitch aren't known, the rates are scaled to their sum, and the
        common level is a nuisance parameter. `scale`: a factor on all rates."""
        self.dataset, self.items = dataset, items
        self.kind = items[0][3]
        lights = {path: dataset.spectrum(path) for path in {item[0] for item in items}}
        camera = dataset.camera
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
        self.scale, self._is_free = scale, measured_e_per_s is not None and not dataset.level_is_known
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
            samples, value = self.dataset.camera.quantum_efficiency[channel].arrays
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
            model = Uniform(self.dataset.camera, spectral)
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
        for channel in self.dataset.channels:
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
