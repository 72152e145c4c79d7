"""Spectral sensitivity from narrowband light: C = S L solved for S, with its uncertainty.

The light's measured spectrum is in L, so the bandwidth of the source is taken out instead of smeared in (which is what
division of C by the light's power does). The problem is ill-posed below the bandwidth: the second difference of S has
a normal prior (Tikhonov), whose strength is what makes the signals most probable (evidence, with the line left free
integrated out), and which is wider where the curve bends and is high: its local scale is the geometric mean of
curvature and height found in a first pass, smoothed, plus a floor that the evidence chooses. S >= 0.

Signals have the noise of the pixels and 0.3 % of the radiometer's repeatability (independent from spectrum to
spectrum). What all signals share (conversion gain, PRNU of the region) is a scale, added to the bands at the end. The
radiometer's absolute calibration is taken as right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize, special

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.fit.weighted_lines import DarkLine, dark_line
from lab.formats.recording_set import RecordingSet
from lab.formats.results import MakerDeparture, NoiseFit, SpectralFit
from sim.camera import Side
from sim.optics.illumination import irradiance_factor
from sim.sensor.mosaic import phases, step
from sim.spectrum import FloatArray, photons_from_energy

COVERAGE_FACTOR = 2.0  # times the standard uncertainty: a band of about 95 %
RADIOMETER_RELATIVE_STD = 0.003  # repeatability of one measured spectrum
LOCAL_WIDTH_NM = 10.0  # over which the local roughness is averaged
ROUGHNESS_FLOORS = (0.02, 0.05, 0.15, 0.4, 1.0, 3.0)  # of the local scale's maximum; 3: the same everywhere
# A recording's curve is stated every 10 nm, mostly at the lights' own wavelengths, where structure finer than the lights shows most.
FINE_LENGTH_NM = 5.0
FINE_SHARE = 0.13  # chosen so that bands hold measured curves at the wavelengths where they are stated
CENTRAL_SHARE = 0.25  # of rows and columns: the region on axis that signals are averaged over
CLIPPED_LIMIT = 1e-4  # share of clipped pixels from which a mean is too low
SATURATED_SHARE = 0.98  # of the fitted full well
FLAT_RANGE = (0.2, 0.9)  # of saturation: flats that may help out
MIN_LIGHTS = 5
OUTPUT_STEP_NM = 10.0
NEGATIVE_LIGHT = 0.05  # of a light's maximum: what a radiometer's noise may go below zero
SEEN_SIGMA = 5.0  # that one signal at least has to stand above the dark
MIN_SPECTRA = 3  # lights that differ: a curve with a bend has three points
CENTROID_MARGIN_NM = 1.0  # beyond the outer lights' centroids that the curve is stated
STATED_DIGITS = 1e-3  # of the maximum: how finely a maker's curve is stated
DETERMINED_SHARE = 0.25  # of the curve's maximum: a standard uncertainty above it says nothing of the value


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """A sensitivity on the wavelengths of the lights, `std` one standard uncertainty, `coverage_factor` what to
    multiply it by for a band of about 95 %, and the covariance (before the positivity, which only takes away). `gain`
    (m, n): by how much the curve moves with each signal; what several channels' signals share is propagated by it.
    """

    sensitivity: FloatArray
    std: FloatArray
    coverage_factor: float
    covariance: FloatArray
    gain: FloatArray

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(m,): where the lights say something of the curve: its standard uncertainty is below a quarter of its
        maximum.
        """
        return self.std < DETERMINED_SHARE * max(float(self.sensitivity.max()), 1e-300)


def estimate_sensitivity(
    wavelength_nm: ArrayLike, lights: ArrayLike, signal: ArrayLike, signal_std: ArrayLike
) -> Sensitivity:
    """Sensitivity S(w) from signals C_i = integral L_i(w) S(w) dw + noise.

    `wavelength_nm` (m,), ascending; `lights` (n, m), photons (or power) per nm; `signal`, `signal_std` (n,). S is in
    signal per photon (or energy), on `wavelength_nm`; integrals are trapezoids. Where no light shines, `std` is large
    and `determined` False. Raises ValueError where shapes don't fit, values aren't finite, a light is negative by more
    than noise, a standard deviation isn't above 0, or there are fewer than 3 lights that differ.
    """
    wave, light, value, std = (np.asarray(a, float) for a in (wavelength_nm, lights, signal, signal_std))
    _check(wave, light, value, std)
    return _solve(wave, light * _trapezoid(wave), value, std)


def _check(wave: FloatArray, light: FloatArray, value: FloatArray, std: FloatArray) -> None:
    if wave.ndim != 1 or light.shape != (value.size, wave.size) or std.shape != value.shape:
        raise ValueError(
            f"{wave.size} wavelengths, lights {light.shape}, {value.size} signals, {std.size} standard deviations: "
            "lights are (signals, wavelengths)"
        )
    if np.any(np.diff(wave) <= 0):
        raise ValueError("wavelengths must ascend: sort them")
    if value.size < 3:
        raise ValueError(f"{value.size} lights, 3 needed: a sensitivity with a second difference has 3 points")
    if not all(np.all(np.isfinite(a)) for a in (light, value, std)) or np.any(std <= 0):
        raise ValueError("lights and signals must be finite, standard deviations above 0 and finite")
    if not np.all(np.any(light > 0, axis=1)):
        raise ValueError(f"light {int(np.argmin(np.any(light > 0, axis=1)))} is dark at all wavelengths: leave it out")
    negative = light.min(axis=1) < -NEGATIVE_LIGHT * light.max(axis=1)
    if negative.any():
        at = int(np.argmax(negative))
        raise ValueError(
            f"light {at} is negative, {light[at].min():.3g} at {wave[np.argmin(light[at])]:g} nm where its maximum is "
            f"{light[at].max():.3g}: measure it again, with the radiometer's dark subtracted"
        )
    if (different := _different(light)) < MIN_SPECTRA:
        raise ValueError(
            f"{value.size} lights, of {different} different spectra, {MIN_SPECTRA} needed: add other lights"
        )


def _different(light: FloatArray) -> int:
    """How many spectra of (n, wavelengths) differ by more than the radiometer's repeatability: the number of singular
    values of the normalised lights above it. One light taken twice, or at two levels, counts once.
    """
    unit = light / np.linalg.norm(light, axis=1, keepdims=True)
    return int(np.sum(np.linalg.svd(unit, compute_uv=False) > np.sqrt(2.0) * RADIOMETER_RELATIVE_STD))


def _trapezoid(wave: FloatArray) -> FloatArray:
    """Weights of the trapezoidal rule."""
    half = np.diff(wave) / 2.0
    return np.append(half, 0.0) + np.append(0.0, half)


@dataclass(frozen=True, eq=False)
class _Bounds:
    """operator S >= limit: what saturated signals say."""

    operator: FloatArray
    limit: FloatArray


def _solve(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    bounds: _Bounds | None = None,
    fine_share: float = 0.0,
) -> Sensitivity:
    """Solution of value = operator S + noise in two passes: alike roughness everywhere, then local, with fine
    structure.
    """
    mean, covariance = _tikhonov(wave, operator, value, std, [np.ones_like(wave)])
    distance = (wave[:, None] - wave) / LOCAL_WIDTH_NM
    average = np.exp(-0.5 * distance**2)
    average /= average.sum(axis=1, keepdims=True)
    for _ in range(2):
        local = _roughness(wave, mean, average)
        if local is None:
            break
        mean, covariance = _tikhonov(
            wave, operator, value, std, [local + floor for floor in ROUGHNESS_FLOORS], fine_share
        )
    everywhere = _Bounds(np.eye(wave.size), np.zeros(wave.size))
    if bounds is not None:
        everywhere = _Bounds(
            np.concatenate([everywhere.operator, bounds.operator]), np.append(everywhere.limit, bounds.limit)
        )
    return Sensitivity(
        _within(mean, covariance, everywhere),
        np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
        COVERAGE_FACTOR,
        covariance,
        (covariance @ operator.T) / std**2,
    )


def _roughness(wave: FloatArray, curve: FloatArray, average: FloatArray) -> FloatArray | None:
    """Where a curve is rough, maximum 1: the geometric mean of its bend and its height, both smoothed. None for a
    line.
    """
    if wave.size < 5:
        return None
    bend = np.sqrt(average @ np.gradient(np.gradient(curve, wave), wave) ** 2)
    height = np.sqrt(average @ np.clip(curve, 0.0, None) ** 2)
    local = np.sqrt(bend * height)
    return local / local.max() if local.max() > 0 else None


def _smooth_root(wave: FloatArray, roughness: FloatArray) -> FloatArray:
    """(m, m): columns span curves whose second difference is white with standard deviation `roughness`, but for the
    line.
    """
    return np.clip(wave[:, None] - wave, 0.0, None) * (np.sqrt(np.gradient(wave)) * roughness)


def _rough_root(wave: FloatArray, roughness: FloatArray, fine_share: float) -> FloatArray:
    """(m, m) like `_smooth_root`, with fine structure beside it: what bends within FINE_LENGTH_NM, exponentially
    correlated, as high as `fine_share` of what the bend amounts to over 10 nm. Lights hardly tell it; the bands have
    to hold it.
    """
    smooth = _smooth_root(wave, roughness)
    if fine_share == 0.0:
        return smooth
    height = fine_share * LOCAL_WIDTH_NM**1.5 * roughness
    fine = np.outer(height, height) * np.exp(-np.abs(wave[:, None] - wave) / FINE_LENGTH_NM)
    return np.linalg.cholesky(smooth @ smooth.T + fine)


def _line(wave: FloatArray) -> FloatArray:
    """(m, 2): the constant and the slope, the curves without a second difference."""
    return np.stack([np.ones_like(wave), 2.0 * (wave - wave.mean()) / np.ptp(wave)], axis=1)


def _evidence(
    root: FloatArray, line: FloatArray, operator: FloatArray, value: FloatArray, std: FloatArray
) -> tuple[float, float]:
    """Negative log evidence of S = line a + strength root u (u standard normal, a free and integrated out) at the
    strength that maximises it, and that strength.
    """
    z, h, f = value / std, operator @ line / std[:, None], operator @ root / std[:, None]
    rest = linalg.qr(h)[0][:, line.shape[1] :]
    eigenvalue, vector = np.linalg.eigh((rest.T @ f) @ (rest.T @ f).T)
    eigenvalue = np.clip(eigenvalue, 0.0, None)
    power = (vector.T @ (rest.T @ z)) ** 2

    def loss(log_square: float) -> float:
        variance = np.exp(log_square) * eigenvalue + 1.0
        return 0.5 * float(np.sum(power / variance + np.log(variance)))

    start = -np.log(max(float(eigenvalue.max()), 1e-300))
    grid = start + np.linspace(-2.0, 40.0, 85)
    best = int(np.argmin([loss(g) for g in grid]))
    found = optimize.minimize_scalar(
        loss, bounds=(grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]), method="bounded"
    )
    return float(found.fun), float(np.exp(0.5 * found.x))


def _tikhonov(
    wave: FloatArray,
    operator: FloatArray,
    value: FloatArray,
    std: FloatArray,
    shapes: Sequence[FloatArray],
    fine_share: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Posterior mean and covariance of S under a second-difference prior and free line; of the prior's `shapes`
    (roughness against wavelength) that with the highest evidence, at its best strength.
    """
    line = _line(wave)
    roots = [_rough_root(wave, shape, fine_share) for shape in shapes]
    roots = [root - line @ np.linalg.lstsq(line, root, rcond=None)[0] for root in roots]  # the line is free anyway
    evidence = [_evidence(root, line, operator, value, std) for root in roots]
    best = min(range(len(roots)), key=lambda i: evidence[i][0])
    # The free line as a normal prior a thousand times as wide as the curve is high. The singular values keep what is well known
    # apart from what isn't: differences of covariances lose that where noise is small.
    height = float(np.max(np.abs(value / operator.sum(axis=1))))
    prior = np.concatenate([1e3 * height * line, evidence[best][1] * roots[best]], axis=1)
    left, singular, right = np.linalg.svd(operator @ prior / std[:, None], full_matrices=True)
    mean = prior @ (
        right[: singular.size].T @ (singular / (1.0 + singular**2) * (left[:, : singular.size].T @ (value / std)))
    )
    known = np.append(1.0 / np.sqrt(1.0 + singular**2), np.ones(right.shape[0] - singular.size))
    half = prior @ right.T * known
    return mean, half @ half.T


def _within(mean: FloatArray, covariance: FloatArray, bounds: _Bounds) -> FloatArray:
    """The most probable curve within bounds, of a normal law: an active set on its dual, S = mean + V G' multiplier."""
    spread = covariance @ bounds.operator.T
    inner = bounds.operator @ spread
    slack = bounds.operator @ mean - bounds.limit
    ridge = 1e-9 * float(np.mean(np.diag(inner))) + 1e-300
    active = np.zeros(slack.size, bool)
    multiplier = np.zeros(slack.size)
    for _ in range(50):
        now = slack + inner @ multiplier
        worst = np.where(active, np.inf, now)
        # New bounds in batches, for neighbours fall together; tolerance on the curve's own scale.
        entering = worst < -1e-6 * float(np.max(np.abs(mean)))
        if not entering.any():
            break
        active |= entering
        while active.any():
            index = np.flatnonzero(active)
            solved = np.linalg.solve(inner[np.ix_(index, index)] + ridge * np.eye(index.size), -slack[index])
            if np.all(solved >= 0):
                break
            active[index[solved < 0]] = False
        multiplier = np.zeros(slack.size)
        if active.any():
            multiplier[active] = solved
    return np.clip(mean + spread @ multiplier, 0.0, None)


# --- where light is missing because it saturated -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Signals:
    """Signals of one channel: operator (n, m) on its quantum efficiency, e/s, and lower limits from saturated ones."""

    operator: FloatArray
    value: FloatArray
    std: FloatArray
    saturated: FloatArray  # (k, m)
    limit: FloatArray
    light: tuple[str, ...] = ()  # paths of the lights' spectra: two channels' signals of one light share its error

    @property
    def has_gaps(self) -> bool:
        return self.limit.size > 0


def _with_maker(wave: FloatArray, signals: Sequence[_Signals], maker: Sequence[FloatArray]) -> list[Sensitivity]:
    """All channels at once, with the maker's curves as prior: S_c = M_c (1 + a + b_c) + d_c.

    `a` is common to the channels (filters in the lens, scale of the radiometer), `b_c` the channel's own (a line of 2
    %), both smooth by their second difference; `d_c` is small and local. The three strengths are found by evidence.
    """
    count, size = len(signals), wave.size
    offsets = np.cumsum([0, *(s.value.size for s in signals)])
    total = int(offsets[-1])
    smooth, line = _smooth_root(wave, np.ones(size)), _line(wave)
    smooth = smooth - line @ np.linalg.lstsq(line, smooth, rcond=None)[0]
    smooth = smooth / np.sqrt(np.mean(smooth**2) * size)  # strengths are then relative deviations
    local = np.exp(-0.5 * ((wave[:, None] - wave) / 15.0) ** 2)
    value = np.concatenate([(s.value - s.operator @ m) / s.std for s, m in zip(signals, maker, strict=True)])
    scaled = [s.operator / s.std[:, None] for s in signals]
    through = np.concatenate([o * m for o, m in zip(scaled, maker, strict=True)])
    kernel_line, kernel_smooth = line @ line.T, smooth @ smooth.T

    def blocks(operators: Sequence[FloatArray], kernel: FloatArray) -> FloatArray:
        return linalg.block_diag(*(o @ kernel @ o.T for o in operators))

    own = [o * m for o, m in zip(scaled, maker, strict=True)]
    pieces = [through @ kernel_smooth @ through.T, blocks(own, kernel_smooth), blocks(scaled, local)]
    fixed = 0.3**2 * through @ kernel_line @ through.T + 0.02**2 * blocks(own, kernel_line) + np.eye(total)
    peak = max(float(m.max()) for m in maker)

    def loss(log_std: FloatArray) -> float:
        weights = np.exp(2.0 * np.asarray(log_std))
        try:
            factor = linalg.cho_factor(fixed + sum(w * p for w, p in zip(weights, pieces, strict=True)))
        except linalg.LinAlgError:
            return 1e12
        # A weak prior keeps strengths that don't matter from running away.
        weak = 0.5 * float(np.sum(((np.asarray(log_std) - centre) / 4.0) ** 2))
        return 0.5 * float(value @ linalg.cho_solve(factor, value)) + float(np.log(np.diag(factor[0])).sum()) + weak

    centre = np.log([0.03, 0.003, 1e-3 * peak])
    starts = [centre, centre + np.array([3.0, 0.0, 0.0])]
    found = min(
        (
            optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02})
            for start in starts
        ),
        key=lambda result: float(result.fun),
    )
    weight = np.exp(2.0 * found.x)
    factor = linalg.cho_factor(fixed + sum(w * p for w, p in zip(weight, pieces, strict=True)))
    common = 0.3**2 * kernel_line + weight[0] * kernel_smooth
    single = 0.02**2 * kernel_line + weight[1] * kernel_smooth
    result = []
    for c in range(count):
        m = maker[c]
        # Covariance of the channel's curve with all signals, and its own.
        cross = (m[:, None] * common) @ through.T
        at = slice(offsets[c], offsets[c + 1])
        cross[:, at] += (m[:, None] * single) @ own[c].T + weight[2] * local @ scaled[c].T
        prior = np.outer(m, m) * (common + single) + weight[2] * local
        mean = m + cross @ linalg.cho_solve(factor, value)
        covariance = prior - cross @ linalg.cho_solve(factor, cross.T)
        bounds = _Bounds(
            np.concatenate([np.eye(size), signals[c].saturated]), np.append(np.zeros(size), signals[c].limit)
        )
        result.append(
            Sensitivity(
                _within(mean, covariance, bounds),
                np.sqrt(np.clip(np.diag(covariance), 0.0, None)),
                COVERAGE_FACTOR,
                covariance,
                linalg.cho_solve(factor, cross.T).T[:, at] / signals[c].std,
            )
        )
    return result


# --- a recording set ---------------------------------------------------------------------------------------------------


def fit_spectral(recordings: RecordingSet, side: Side, noise: NoiseFit | None = None) -> SpectralFit:
    """Absolute quantum efficiency of every channel from the narrowband captures, electrons a photon at the pixel.

    Irradiance on axis: pi T L / (1 + 4 N^2); the stated lens transmittance and fill factor are divided out, and the
    region's mean cos^4. Signals are means over the central quarter of rows and columns. Saturated captures are left
    out; where a channel has no other light, the maker's curves (times a smooth factor that the channels share, and a
    smooth few per cent of its own) and the flats with a stated radiance fill in, or without these smoothness alone.
    Raises NotDetermined where the scale or the light is missing.
    """
    return _Recording(recordings, side, noise).fit()


class _Recording:
    """Signals and lights of one camera's captures."""

    def __init__(self, recordings: RecordingSet, side: Side, noise: NoiseFit | None) -> None:
        self.recordings, self.side, self.noise = recordings, side, noise
        self.camera = recordings.camera(side)
        self.remarks: list[str] = []
        self.narrowband: list[NarrowbandCapture | FlatCapture] = [
            c for c in recordings.captures("narrowband", side) if c.exposure_s > 0
        ]
        if len({self._path(c) for c in self.narrowband}) < MIN_LIGHTS:
            # Broadband lights of known radiance, LEDs or lamps behind filters, say the same in fewer words.
            flats = [f for f in recordings.captures("flat", side) if f.exposure_s > 0 and f.radiance is not None]
            self.narrowband.extend(flats)
            if not self.narrowband:
                raise NotDetermined(
                    "spectral",
                    "no narrowband captures and no flats of known radiance: capture narrowband light over the visible by "
                    "10 nm or finer",
                )
        self.gain, self.gain_std = self._conversion_gain()
        self.region = self._central_region()
        self.pixels = {channel: self._count(channel) for channel in phases(self.camera.cfa)}
        self.photons = self._photons_per_radiance()
        self.darks: dict[tuple[float, str], DarkLine] = {}

    @staticmethod
    def _path(capture: NarrowbandCapture | FlatCapture) -> str:
        return cast(str, capture.radiance)

    def _conversion_gain(self) -> tuple[float, float]:
        if self.noise is not None and self.noise.conversion_gain_dn_per_e is not None:
            return self.noise.conversion_gain_dn_per_e, self.noise.conversion_gain_dn_per_e_std or 0.0
        if self.camera.conversion_gain_dn_per_e is not None:
            self.remarks.append(
                "the conversion gain is the maker's: the scale of the quantum efficiency stands with it"
            )
            return self.camera.conversion_gain_dn_per_e, 0.0
        raise NotDetermined(
            "spectral", "the conversion gain isn't known: capture flats with repeats, or state conversion_gain_dn_per_e"
        )

    def _photons_per_radiance(self) -> float:
        """Photons s^-1 at one pixel on axis per radiance in photons s^-1 m^-2 sr^-1, with the region's cos^4."""
        camera = self.camera
        missing = [key for key in ("f_number", "pixel_pitch_um") if getattr(camera, key) is None]
        if missing:
            raise NotDetermined(
                "spectral", f"{' and '.join(missing)} unknown: state it, the photons at a pixel follow from it"
            )
        for key, what in (
            ("lens_transmittance", "the lens's losses are part of the quantum efficiency"),
            ("fill_factor", "the quantum efficiency is that of the whole pixel"),
        ):
            if getattr(camera, key) is None:
                self.remarks.append(f"{key} is unknown and taken as 1: {what}")
        pitch_m = cast(float, camera.pixel_pitch_um) * 1e-6
        return (
            irradiance_factor(cast(float, camera.f_number))
            * (camera.lens_transmittance or 1.0)
            * (camera.fill_factor or 1.0)
            * pitch_m**2
            * self._fall_off()
        )

    def _central_region(self) -> tuple[slice, slice]:
        """Rows and columns of the region, whole periods of the mosaic."""
        period = step(self.camera.cfa)
        spans = []
        for size in (self.camera.rows, self.camera.cols):
            half = max(round(size * CENTRAL_SHARE / 2 / period), 1) * period
            middle = size // 2 // period * period
            spans.append(slice(max(middle - half, 0), min(middle + half, size)))
        return spans[0], spans[1]

    def _fall_off(self) -> float:
        """Mean cos^4 over the region, about the frame's centre."""
        if self.camera.focal_length_mm is None or self.camera.pixel_pitch_um is None:
            return 1.0
        scale = self.camera.pixel_pitch_um * 1e-3 / self.camera.focal_length_mm
        rows, cols = (np.arange(s.start, s.stop) for s in self.region)
        y = (rows - 0.5 * (self.camera.rows - 1)) * scale
        x = (cols - 0.5 * (self.camera.cols - 1)) * scale
        return float(np.mean(1.0 / (1.0 + y[:, None] ** 2 + x**2) ** 2))

    def _values(self, capture: Capture) -> dict[str, FloatArray]:
        """DN of each channel's pixels in the region."""
        frame = self.recordings.frame(capture)[self.region]
        period = step(self.camera.cfa)  # the region starts on whole periods
        return {
            channel: np.concatenate([frame[r::period, c::period].ravel() for r, c in at]).astype(float)
            for channel, at in phases(self.camera.cfa).items()
        }

    def _count(self, channel: str) -> int:
        rows, cols = (s.stop - s.start for s in self.region)
        return rows * cols // step(self.camera.cfa) ** 2 * len(phases(self.camera.cfa)[channel])

    def _dark(self, gain_db: float, channel: str, exposure_s: float) -> tuple[float, float]:
        """Dark mean in the region and its uncertainty."""
        if not self.darks:
            self._read_darks()
        line = self.darks.get((gain_db, channel))
        if line is not None:
            basis = np.array([1.0, exposure_s])
            return line.at(exposure_s), float(np.sqrt(basis @ line.covariance @ basis))
        black = self.noise.black_level_dn if self.noise is not None else None
        black = self.camera.black_level_dn if black is None else black
        if black is None:
            raise NotDetermined(
                "spectral", "neither darks nor a black level: capture darks at the narrowband exposures"
            )
        rate = (self.noise.dark_current_e_per_s or 0.0) if self.noise is not None else 0.0
        return black + rate * exposure_s * self._dn_per_e(gain_db), 0.0

    def _read_darks(self) -> None:
        found: dict[tuple[float, str], list[tuple[float, float, float]]] = {}
        for dark in self.recordings.captures("dark", self.side):
            for channel, values in self._values(dark).items():
                own = found.setdefault((dark.gain_db or 0.0, channel), [])
                own.append(
                    (dark.exposure_s, float(values.mean()), float(np.hypot(values.std(), 0.3) / np.sqrt(values.size)))
                )
        for key, rows in found.items():
            self.darks[key] = dark_line(*np.array(rows).T)

    def _dn_per_e(self, gain_db: float | None) -> float:
        return self.gain * 10.0 ** ((gain_db or 0.0) / 20.0)

    def _rate(self, capture: Capture, channel: str, values: FloatArray) -> tuple[float, float, bool, float]:
        """Electrons per second, their standard uncertainty, whether the capture saturates, and its share of
        saturation.
        """
        gain = self._dn_per_e(capture.gain_db)
        dark, dark_std = self._dark(capture.gain_db or 0.0, channel, capture.exposure_s)
        signal = float(values.mean()) - dark
        limit = self.camera.saturation_dn - dark
        if self.noise is not None and self.noise.full_well_e is not None:
            limit = min(limit, self.noise.full_well_e * gain)
        clipped = (
            float(np.mean(values >= self.camera.saturation_dn)) > CLIPPED_LIMIT or signal > SATURATED_SHARE * limit
        )
        scale = 1.0 / (gain * capture.exposure_s)
        # The spread of the pixels holds shot noise, read noise and PRNU.
        std = float(np.hypot(np.hypot(values.std(), 0.3) / np.sqrt(values.size), dark_std))
        return signal * scale, std * scale, clipped, signal / limit

    def _lights(self) -> dict[str, FloatArray]:
        """Spectral photon rates of a pixel (photons s^-1 nm^-1) by the path of the radiance, on `self.wave`."""
        paths = dict.fromkeys(self._path(capture) for capture in self.narrowband)
        spectra = {path: self.recordings.spectrum(path) for path in paths}
        for path in paths:
            value = spectra[path].arrays[1]
            if not np.all(np.isfinite(value)) or value.min() < -NEGATIVE_LIGHT * value.max():
                self.remarks.append(
                    f"the light {path} is left out: its radiance is negative or not a number "
                    f"(lowest {value.min():.3g}, highest {value.max():.3g}); measure it again"
                )
                del spectra[path]
        low, high = np.inf, -np.inf
        for spectrum in spectra.values():
            wave, value = np.array(spectrum.wavelength_nm), np.array(spectrum.value)
            lit = wave[value > 1e-3 * value.max()] if value.max() > 0 else wave[:0]
            if lit.size:
                low, high = min(low, lit[0]), max(high, lit[-1])
        if not low < high:
            raise NotDetermined("spectral", "all spectra are dark or unusable: measure them with the light on")
        self.wave = np.arange(np.floor(low), np.ceil(high) + 0.5)
        return {path: self._photon_rate(path) for path in spectra}

    def _photon_rate(self, path: str) -> FloatArray:
        spectrum = self.recordings.spectrum(path)
        return self.photons * photons_from_energy(self.wave, np.clip(spectrum.at(self.wave), 0.0, None))

    def _signals(self) -> dict[str, _Signals]:
        lights = self._lights()
        weights = _trapezoid(self.wave)
        rates: dict[tuple[str, str], list[tuple[float, float, bool, float]]] = {}
        for capture in self.narrowband:
            for channel, values in self._values(capture).items():
                rates.setdefault((channel, self._path(capture)), []).append(self._rate(capture, channel, values))
        result = {}
        for channel in phases(self.camera.cfa):
            good: list[tuple[FloatArray, float, float]] = []
            seen: list[str] = []
            high: list[tuple[FloatArray, float]] = []
            for path, light in lights.items():
                if not np.any(light > 0):
                    continue
                found = rates[channel, path]
                usable = [(rate, std) for rate, std, clipped, _ in found if not clipped]
                if usable:
                    weight = 1.0 / np.array([std for _, std in usable]) ** 2
                    mean = float(np.sum(weight * [rate for rate, _ in usable]) / weight.sum())
                    spread = float(np.sqrt(1.0 / weight.sum()))
                    seen.append(path)
                    good.append((light * weights, mean, float(np.hypot(spread, RADIOMETER_RELATIVE_STD * mean))))
                else:
                    # A saturated mean is a lower limit; 1 % below leaves room for its noise.
                    high.append((light * weights, 0.99 * max(rate for rate, *_ in found)))
            if len(good) < MIN_LIGHTS:
                found_so_many = (
                    f"only {len(good)} of {len(lights)} lights leave channel {channel} unsaturated, {MIN_LIGHTS} needed: expose shorter"
                    if high
                    else f"{len(good)} different lights, {MIN_LIGHTS} needed: capture narrowband light over the visible by 10 nm or finer"
                )
                raise NotDetermined("spectral", found_so_many)
            if (different := _different(np.array([g[0] for g in good]))) < MIN_LIGHTS:
                raise NotDetermined(
                    "spectral",
                    f"the {len(good)} lights are of {different} different spectra, {MIN_LIGHTS} needed: capture narrowband light over "
                    "the visible by 10 nm or finer",
                )
            size = self.wave.size
            result[channel] = _Signals(
                np.array([g[0] for g in good]),
                np.array([g[1] for g in good]),
                np.array([g[2] for g in good]),
                np.array([h[0] for h in high]).reshape(-1, size),
                np.array([h[1] for h in high]),
                tuple(seen),
            )
        return result

    def _with_flats(self, signals: dict[str, _Signals]) -> dict[str, _Signals]:
        """The signals and those of the flats whose radiance is known: one for each spectrum."""
        rates: dict[tuple[str, str], list[tuple[float, float]]] = {}
        used: dict[str, list[FlatCapture]] = {}
        for flat in self.recordings.captures("flat", self.side):
            if flat.radiance is not None and flat.exposure_s > 0:
                used.setdefault(flat.radiance, []).append(flat)
        for path, flats in used.items():
            for flat in flats:
                for channel, values in self._values(flat).items():
                    rate, std, clipped, share = self._rate(flat, channel, values)
                    if not clipped and FLAT_RANGE[0] < share < FLAT_RANGE[1]:
                        rates.setdefault((channel, path), []).append((rate, std))
        weights = _trapezoid(self.wave)
        result = {}
        for channel, own in signals.items():
            rows, values_, stds, seen = [own.operator], [own.value], [own.std], list(own.light)
            for path in used:
                found = rates.get((channel, path))
                spectrum = self.recordings.spectrum(path)
                total = np.trapezoid(spectrum.value, spectrum.wavelength_nm)
                inside = float(np.trapezoid(spectrum.at(self.wave), self.wave))
                # Light beyond the narrowband range would be counted as light inside.
                if not found or inside < 0.95 * total:
                    continue
                weight = 1.0 / np.array([std for _, std in found]) ** 2
                mean = float(np.sum(weight * [rate for rate, _ in found]) / weight.sum())
                outside = 1.0 - inside / total
                seen.append(path)
                rows.append((self._photon_rate(path) * weights)[None])
                values_.append(np.array([mean]))
                stds.append(np.array([mean * np.hypot(RADIOMETER_RELATIVE_STD, outside)]))
            result[channel] = _Signals(
                np.concatenate(rows),
                np.concatenate(values_),
                np.concatenate(stds),
                own.saturated,
                own.limit,
                tuple(seen),
            )
        return result

    def _maker(self) -> dict[str, FloatArray] | None:
        stated = self.camera.quantum_efficiency or {}
        if not all(channel in stated for channel in phases(self.camera.cfa)):
            return None
        curves = {
            c: np.clip(self.recordings.spectrum(stated[c]).at(self.wave), 0.0, None) for c in phases(self.camera.cfa)
        }
        return curves if all(curve.max() > 0 for curve in curves.values()) else None

    def fit(self) -> SpectralFit:
        signals = self._signals()
        gaps = {c: s.limit.size for c, s in signals.items() if s.has_gaps}
        maker = self._maker() if gaps else None
        if gaps:
            listed = ", ".join(f"{channel} under {count}" for channel, count in gaps.items())
            filled = (
                "there the curve rests on the maker's, times a smooth factor that the channels share, and on the flats"
                if maker
                else "there the curve is known from below and by its smoothness alone"
            )
            self.remarks.append(
                f"saturated narrowband captures are left out ({listed} lights): {filled}; expose shorter to measure it"
            )
        if maker:
            signals = self._with_flats(signals)
            solved = dict(
                zip(signals, _with_maker(self.wave, list(signals.values()), [maker[c] for c in signals]), strict=True)
            )
        else:
            solved = {
                c: _solve(
                    self.wave,
                    s.operator,
                    s.value,
                    s.std,
                    _Bounds(s.saturated, s.limit) if s.has_gaps else None,
                    FINE_SHARE,
                )
                for c, s in signals.items()
            }
        self.leans_on_maker = bool(maker)
        return self._result(solved, signals)

    def _span(self) -> tuple[float, float]:
        """First and last wavelength that the lights can speak of: narrowband by the centroids of their measured
        spectra (their names may be some nm off), broadband wholly.
        """
        if any(isinstance(capture, FlatCapture) for capture in self.narrowband):
            return float(self.wave[0]), float(self.wave[-1])
        paths = {self._path(capture) for capture in self.narrowband}
        centroids = []
        for rate in (self._photon_rate(path) for path in paths):
            if rate.max() > 0:
                centroids.append(float(np.sum(rate * self.wave) / rate.sum()))
        margin = CENTROID_MARGIN_NM
        return max(min(centroids) - margin, self.wave[0]), min(max(centroids) + margin, self.wave[-1])

    def _result(self, solved: dict[str, Sensitivity], signals: dict[str, _Signals]) -> SpectralFit:
        low, high = self._span()
        out = np.arange(np.ceil(low / OUTPUT_STEP_NM), np.floor(high / OUTPUT_STEP_NM) + 1) * OUTPUT_STEP_NM
        known = {c: np.interp(out, self.wave, found.determined.astype(float)) > 0.5 for c, found in solved.items()}
        any_channel = np.flatnonzero(np.any(list(known.values()), axis=0))
        inside = slice(any_channel[0], any_channel[-1] + 1) if any_channel.size else slice(0, 0)
        out = out[inside]
        highest = max(float(np.max(own.value / own.std)) for own in signals.values())
        if highest < SEEN_SIGMA and not any(own.has_gaps for own in signals.values()):
            raise NotDetermined(
                "spectral",
                f"the captures show no light: the strongest signal is {highest:.1f} standard uncertainties above the dark, {SEEN_SIGMA:g} "
                "needed: open the shutter, or expose longer",
            )
        if out.size < 2:
            raise NotDetermined(
                "spectral",
                f"the lights within {low:.0f}..{high:.0f} nm don't span the spectrum: capture narrowband light over the visible by "
                "10 nm or finer",
            )
        gaps = {c: _runs(out, ~k[inside]) for c, k in known.items()}
        for channel, runs in gaps.items():
            if runs:
                where = ", ".join(f"{a:g}..{b:g} nm" for a, b in runs)
                self.remarks.append(
                    f"{channel} isn't identifiable at {where}: no light that was measured tells it there; capture narrowband light there"
                )
        channels = list(solved)
        joint = _joint(self.wave, out, solved, signals)
        value = np.concatenate([np.interp(out, self.wave, solved[c].sensitivity) for c in channels])
        # The region's own PRNU differs from channel to channel; the conversion gain is the same for all.
        prnu = (self.noise.prnu_percent if self.noise is not None else None) or 0.0
        for k, channel in enumerate(channels):
            at = slice(k * out.size, (k + 1) * out.size)
            joint[at, at] += (prnu / 100.0) ** 2 / self.pixels[channel] * np.outer(value[at], value[at])
        absolute = np.sqrt(np.diag(joint) + (self.gain_std / self.gain * value) ** 2)
        peak = int(np.argmax(value))
        ratio = value / value[peak]
        spread = np.diag(joint) - 2.0 * ratio * joint[peak] + ratio**2 * joint[peak, peak]
        relative = np.sqrt(np.clip(spread, 0.0, None)) / value[peak]

        def by_channel(array: FloatArray) -> dict[str, tuple[float, ...]]:
            return {c: tuple(row.tolist()) for c, row in zip(channels, array.reshape(len(channels), -1), strict=True)}

        scale, departures = self._departures(out, channels, value, joint)
        return SpectralFit(
            wavelength_nm=tuple(out.tolist()),
            quantum_efficiency=by_channel(value),
            quantum_efficiency_std=by_channel(absolute),
            relative_sensitivity=by_channel(ratio),
            relative_sensitivity_std=by_channel(relative),
            not_determined_nm={c: runs for c, runs in gaps.items() if runs},
            maker_scale=scale,
            maker_departures=departures,
            coverage_factor=COVERAGE_FACTOR,
            remarks=tuple(self.remarks),
        )

    def _departures(
        self, out: FloatArray, channels: Sequence[str], value: FloatArray, joint: FloatArray
    ) -> tuple[float | None, tuple[MakerDeparture, ...]]:
        """The maker's curves beside the fitted ones. None where the maker states none, or where the fit leans on
        them.
        """
        maker = self._maker()
        if maker is None or self.leans_on_maker:
            return None, ()
        ends = [
            self.recordings.spectrum((self.camera.quantum_efficiency or {})[c]).arrays[0][[0, -1]] for c in channels
        ]
        covered = (out >= max(low for low, _ in ends)) & (out <= min(high for _, high in ends))
        if not covered.any():
            return None, ()
        every = np.tile(covered, len(channels))
        stated = np.concatenate([np.interp(out[covered], self.wave, maker[c]) for c in channels])
        return compare_curves(out[covered], channels, value[every], joint[np.ix_(every, every)], stated)


def _runs(wave: FloatArray, where: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """First and last wavelength of each run."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return tuple((float(wave[a]), float(wave[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def _joint(
    wave: FloatArray, out: FloatArray, solved: dict[str, Sensitivity], signals: dict[str, _Signals]
) -> FloatArray:
    """Covariance of all channels' curves at `out`, channel after channel. Channels share the radiometer's error of
    each light: Cov(S_c, S_d) = G_c diag(r^2 C_c C_d) G_d'.
    """
    at = np.stack([np.interp(out, wave, row) for row in np.eye(wave.size)], axis=1)
    blocks = []
    for c, one in solved.items():
        row = []
        for d, two in solved.items():
            if c == d:
                row.append(at @ one.covariance @ at.T)
                continue
            place = {path: i for i, path in enumerate(signals[d].light)}
            pairs = np.array([(i, place[p]) for i, p in enumerate(signals[c].light) if p in place], int).reshape(-1, 2)
            i, j = pairs.T
            shared = RADIOMETER_RELATIVE_STD**2 * signals[c].value[i] * signals[d].value[j]
            row.append((at @ one.gain[:, i] * shared) @ (at @ two.gain[:, j]).T)
        blocks.append(row)
    return np.block(blocks)


# --- beside the maker's curves -----------------------------------------------------------------------------------------


def compare_curves(
    wavelength_nm: FloatArray, channels: Sequence[str], value: FloatArray, covariance: FloatArray, stated: FloatArray
) -> tuple[float, tuple[MakerDeparture, ...]]:
    """Where fitted curves part from stated ones, but for one factor that all channels share.

    `value`, `stated` (channels x wavelengths,), channel after channel; `covariance` of `value` without what is common
    to all. The factor is the median of value / stated where `stated` is above a fifth of its maximum: bands that part
    don't move it. Every band of neighbouring wavelengths of every channel is tested by its mean difference; the
    significance (normal, two-sided) is allowed for the number of bands. Bands are taken by significance, each apart
    from those before it, down to the level that curves which are as stated exceed in at most 1 % of fits.
    """
    high = stated > 0.2 * stated.max()
    scale = float(np.median(value[high] / stated[high]))
    # The factor's own error, as by a mean over where it was taken.
    weight = high / (high.sum() * np.where(high, stated, 1.0))
    centre = np.eye(value.size) - np.outer(stated, weight)
    spread = centre @ covariance @ centre.T + (STATED_DIGITS * stated.max()) ** 2 * np.eye(value.size)
    difference = value - scale * stated
    size = wavelength_nm.size
    found: list[tuple[float, int, int, int]] = []
    for k in range(len(channels)):
        own = slice(k * size, (k + 1) * size)
        total = np.concatenate([[0.0], np.cumsum(difference[own])])
        square = np.zeros((size + 1, size + 1))
        square[1:, 1:] = np.cumsum(np.cumsum(spread[own, own], axis=0), axis=1)
        for a in range(size):
            for b in range(a + 1, size + 1):
                variance = square[b, b] - 2.0 * square[a, b] + square[a, a]
                found.append((abs(total[b] - total[a]) / float(np.sqrt(variance)), k, a, b))
    count = len(found)
    limit = float(special.ndtri(1.0 - 0.005 / count))
    departures: list[MakerDeparture] = []
    taken = np.zeros((len(channels), size), bool)
    for z, k, a, b in sorted(found, reverse=True):
        if z <= limit:
            break
        if taken[k, a:b].any():
            continue
        taken[k, max(a - 1, 0) : b + 1] = True
        part = slice(k * size + a, k * size + b)
        mean, expected = float(difference[part].mean()), float(scale * stated[part].mean())
        log_p = min(float(special.log_ndtr(-z)) + float(np.log(count)), -0.7)
        departures.append(
            MakerDeparture(
                channel=channels[k],
                from_nm=float(wavelength_nm[a]),
                to_nm=float(wavelength_nm[b - 1]),
                difference=mean,
                difference_std=abs(mean) / z,
                difference_percent=100.0 * mean / expected if expected > 0 else None,
                significance_sigma=float(-special.ndtri_exp(log_p)),
            )
        )
    return scale, tuple(departures)
