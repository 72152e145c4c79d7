"""The correlation of the temporal noise of neighbouring pixels, in the dark and in uniform light; and tones in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.ndimage import convolve1d

from lab.errors import NotDetermined
from lab.observables.dataset import Dataset
from lab.observables.noise.temporal import OUTLIER, PAIRS, dark_repeats, flat_repeats
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from lab.observables.reads import READ_SPECTRUM
from sim.camera import CameraModel, Cfa
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.electrons import NEIGHBOURS, solve_passed_share
from sim.sensor.reading_order import ReadOutNoise
from sim.spectrum import FloatArray
from sim.uniform import Uniform

CORRELATION_FLOOR = 3e-4  # standard deviation of a correlation beside chance


def measure_noise_neighbours(dataset: Dataset) -> Observable:
    """Correlation of the temporal noise of neighbouring pixels (`PAIRS`), by level of light and in the dark.

    It is 0 where pixels are independent, whatever gain, noise and level are. Raises NotDetermined without repeats whose
    noise exceeds a code.
    """
    points = [
        r for r in (*dataset.once(dark_repeats), *dataset.once(flat_repeats)) if np.all(np.isfinite(r.correlation))
    ]
    if not points:
        raise NotDetermined(
            "noise_neighbours", "no repeats of dark or unclipped flat captures whose noise exceeds a code"
        )
    noise, camera = dataset.noise, dataset.camera
    lit = [r.level > max(20.0 * abs(noise.dark_dn_per_s) * r.exposure_s, 4.0 * noise.read_dn) for r in points]
    level = np.array([max(r.level, 1.0) for r in points])
    value = np.concatenate([r.correlation for r in points])
    covariance = block_diag(*(r.correlation_covariance for r in points))
    names = list(PAIRS)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(camera, effects)
        kernel, read_kernel = model.filter_kernel(), model.read_kernel()
        ordered = [OrderedCovariance.of(one, camera) for one in model.reading_order]
        if kernel is None and read_kernel is None and not model.shares_shot_noise and not ordered:
            return Prediction(np.zeros(len(value)), {})
        parts = []
        for r in points:
            gain, gain_db = noise.gain * r.gain, dataset.usual_gain_db + 20.0 * np.log10(r.gain)
            electrons = np.array([max(s, 0.0) / gain for s in r.ordinary.values()])
            read = max(noise.read_dn**2 - noise.quantisation_dn2, 0.1 * noise.read_dn**2) / noise.gain**2
            slow = sum(one.own_e2 for one in ordered)  # a part of what is measured as read noise
            parts.append(
                correlations(
                    camera.cfa,
                    list(r.signal),
                    np.maximum(model.shot_e2(electrons, gain_db), 0.0),
                    solve_passed_share(model.neighbour_correlation(electrons)),
                    max(read - slow, 0.1 * read),
                    noise.quantisation_dn2 / gain**2,
                    kernel,
                    read_kernel,
                    ordered,
                )
            )
        return Prediction(np.concatenate(parts), {})

    return Observable(
        measurement=NOISE_NEIGHBOURS, reach=LEVEL_REACH, along=np.repeat(np.log(level), len(names)),
        value=value, covariance=covariance + CORRELATION_FLOOR**2 * np.eye(len(value)),
        labels=tuple(Label(r.level if bright else 0.0, name, f"{r.exposure_s:.4g} s" if bright else f"dark, {r.exposure_s:.4g} s", r.captures, r.held_out)  # noqa: E501
                     for r, bright in zip(points, lit, strict=True) for name in names),
        reads=frozenset({"signal.filters", "signal.reading_order", "charge.correlation"}) | READ_SPECTRUM,
        predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def measure_noise_tones(dataset: Dataset) -> Observable:
    """Share of tones in the variance of dark frames' temporal noise.

    Tones are frequencies across a frame that stand out of the noise by `temporal_noise.OUTLIER`, beside those of whole
    rows and columns: clocks of the read-out, of another phase in every frame. The standard deviation is the spread over
    settings, as phases are random (of a single one, its share), and that of one tone. Raises NotDetermined without
    repeated dark frames whose noise exceeds a code.
    """
    dark = [r for r in dataset.once(dark_repeats) if np.all(np.isfinite(r.correlation))]
    if not dark:
        raise NotDetermined("noise_tones", "no repeats of dark captures whose noise exceeds a code")
    value, variance, labels = [], [], []
    for held_out in sorted({r.held_out for r in dark}):
        points = [r for r in dark if r.held_out == held_out]
        shares = np.array([r.tones for r in points])
        spread = float(shares.std(ddof=1)) if len(shares) > 1 else float(shares[0])
        value.append(float(shares.mean()))
        variance.append((spread**2 + float(np.mean([r.one_tone for r in points])) ** 2) / len(points))
        labels.append(Label(0.0, "all", "dark", tuple(c for r in points for c in r.captures), held_out))
    # no effect leaves tones
    return Observable(
        measurement=NOISE_TONES, reach=LEVEL_REACH, value=np.array(value), covariance=np.diag(variance),
        labels=tuple(labels), reads=frozenset(),
        predict=lambda effects: Prediction(np.zeros(len(value)), {}), scale=np.ones(len(value)),
    )  # fmt: skip


@dataclass(frozen=True)
class OrderedCovariance:
    """Noise in reading order after the means of rows were taken out of each plane of the mosaic: variance of a pixel,
    and covariance by (phase of the column, rows down, columns to the right) of `PAIRS`, e^2; and the power of waves
    that alternate from column to column, by cycles down the frame, which may stand out as tones do. A mosaic's planes
    lose these with their rows' means."""

    own_e2: float
    shared_e2: Mapping[tuple[int, int, int], float]
    alternating_e2: FloatArray  # (rows,); of a mosaic (0,)
    pixels: int

    @staticmethod
    def of(noise: ReadOutNoise, camera: CameraModel) -> OrderedCovariance:
        """Return the covariances in frames of a camera."""
        shape, period = (camera.rows, camera.cols), mosaic.step(camera.cfa)
        lags = [lag for every in PAIRS.values() for lag in every]
        own = [noise.departures_e2(shape, period, phase, 0, 0) for phase in range(period)]
        shared = {
            (phase, down, right): noise.departures_e2(shape, period, phase, down, right)
            for phase in range(period)
            for down, right in lags
        }
        down_cy_per_px = np.arange(1, camera.rows if period == 1 else 1) / camera.rows  # 0: of the columns' means
        alternating = noise.plane_e2(shape, np.full(len(down_cy_per_px), 0.5), down_cy_per_px)
        return OrderedCovariance(float(np.mean(own)), shared, alternating, camera.rows * camera.cols)

    def taken_out_e2(self, total_e2: float) -> dict[tuple[int, int], float]:
        """Return the covariances of pixels, by (rows down, columns to the right) of `PAIRS`, that tones have which are
        taken out: powers that by chance, each distributed exponentially, exceed `OUTLIER`^2 of the mean power, a
        pixel's variance."""
        lags = [lag for every in PAIRS.values() for lag in every]
        if not len(self.alternating_e2):
            return dict.fromkeys(lags, 0.0)
        mean = self.alternating_e2 + total_e2 - self.own_e2
        least = OUTLIER**2 * total_e2
        taken = (least + mean) * np.exp(-least / mean)
        cycles = np.arange(1, len(taken) + 1) / (len(taken) + 1)
        by_rows = {down: float(taken @ np.cos(2.0 * np.pi * down * cycles)) for down in {down for down, _ in lags}}
        return {(down, right): by_rows[down] * (-1.0) ** right / self.pixels for down, right in lags}


def correlations(
    cfa: Cfa,
    planes: Sequence[str],
    shot_e2: FloatArray,
    share: FloatArray,
    read_e2: float,
    rounding_e2: float,
    kernel: FloatArray | None,
    read_kernel: FloatArray | None = None,
    ordered: Sequence[OrderedCovariance] = (),
) -> FloatArray:
    """Predicted correlations by `PAIRS` in uniform light, (6,): means over the phases of the mosaic.

    `shot_e2` (planes,): variance of the shot noise; `share` (5, planes): share of the departure from its mean of each
    neighbour, by `NEIGHBOURS`, that a pixel takes over. Read noise (`read_e2`) is independent, or
    made of such noise by `read_kernel` (odd,) along the row. `kernel` filters both within a plane. Rounding
    (`rounding_e2`) is added last and is independent. `ordered`: noise in reading order beside, which no filter changes.
    """
    period = 1 if cfa == "MONO" else 2
    at = dict.fromkeys(planes, (0, 0)) if period == 1 else _phase_of(cfa)
    variance, taken = np.zeros((period, period)), np.zeros((len(NEIGHBOURS), period, period))
    for name, v, g in zip(planes, shot_e2, share.T, strict=True):
        variance[at[name]], taken[:, *at[name]] = v, g
    own, shared = (
        _covariances(variance, taken, read_e2, kernel, read_kernel)
        if kernel is not None or taken.any()
        else _without_neighbours(variance, read_e2, read_kernel)
    )
    total = {p: e2 + rounding_e2 + sum(o.own_e2 for o in ordered) for p, e2 in own.items()}
    whole = float(np.mean(list(total.values())))
    taken_out = [noise.taken_out_e2(whole) for noise in ordered]
    found = np.zeros(len(PAIRS))
    for k, lags in enumerate(PAIRS.values()):
        parts = []
        for phase, own_e2 in total.items():
            for down, right in lags:
                other = (phase[0] + down) % period, (phase[1] + right) % period
                e2 = shared[phase, (down, right)]
                for noise, less in zip(ordered, taken_out, strict=True):
                    e2 += noise.shared_e2[phase[1], down, right] - less[down, right]
                parts.append(e2 / np.sqrt(own_e2 * total[other]))
        found[k] = np.mean(parts)
    return found


#: A pixel of the mosaic's period, and (rows down, columns to the right).
_Phase = tuple[int, ...]
_Lag = tuple[int, int]


def _without_neighbours(
    variance: FloatArray, read_e2: float, read_kernel: FloatArray | None
) -> tuple[dict[_Phase, float], dict[tuple[_Phase, _Lag], float]]:
    """Return the same as `_covariances` where no pixel takes anything over and nothing is filtered."""
    along = np.ones(1) if read_kernel is None else np.correlate(read_kernel, read_kernel, mode="full")
    middle = len(along) // 2
    reach = {(0, right): read_e2 * float(along[middle + right]) for right in range(-middle, middle + 1)}
    phases = list(np.ndindex(variance.shape))
    lags = [lag for every in PAIRS.values() for lag in every]
    own = {phase: float(variance[phase]) + reach[0, 0] for phase in phases}
    return own, {(phase, lag): reach.get(lag, 0.0) for phase in phases for lag in lags}


def _covariances(
    variance: FloatArray,
    taken: FloatArray,
    read_e2: float,
    kernel: FloatArray | None,
    read_kernel: FloatArray | None,
) -> tuple[dict[_Phase, float], dict[tuple[_Phase, _Lag], float]]:
    """Return the variance of a pixel by its phase in the mosaic, and its covariance with those of `PAIRS`, e^2.

    `variance` (period, period) of the shot noise; `taken` (5, period, period): shares of neighbours' departures.
    """
    period = len(variance)
    taps = np.ones((1, 1)) if kernel is None else kernel
    half = taps.shape[0] // 2 * period + 2
    reach = half + 2 + (0 if read_kernel is None else len(read_kernel) // 2)
    size = 2 * reach + 1
    offset = np.arange(size) - reach
    weights: dict[tuple[int, int], FloatArray] = {}  # (shot and read noise, size, size)
    for phase in np.ndindex(period, period):
        row, col = (phase[0] + offset) % period, (phase[1] + offset) % period
        own, shares = variance[np.ix_(row, col)], [g[np.ix_(row, col)] for g in taken]
        more = sum(np.square(g) * _neighbours(own, places) for g, places in zip(shares, NEIGHBOURS, strict=True))
        norm = 1.0 / np.sqrt(1.0 + more / np.maximum(own, 1e-12))
        read = np.zeros((size, size))
        middle = taps.shape[0] // 2
        for (i, j), tap in np.ndenumerate(taps):
            read[reach + (i - middle) * period, reach + (j - middle) * period] = tap
        shot = read * norm
        shot = shot + sum(_neighbours(read * norm * g, places) for g, places in zip(shares, NEIGHBOURS, strict=True))
        if read_kernel is not None:
            read = convolve1d(read, read_kernel, axis=1, mode="constant")
        weights[phase] = np.stack([shot * np.sqrt(own), read * np.sqrt(read_e2)])
    shared: dict[tuple[_Phase, _Lag], float] = {}
    for phase, here in weights.items():
        for down, right in (lag for every in PAIRS.values() for lag in every):
            other = (phase[0] + down) % period, (phase[1] + right) % period
            mine = here[:, max(down, 0) : size + min(down, 0), max(right, 0) : size + min(right, 0)]
            theirs = weights[other][:, max(-down, 0) : size - max(down, 0), max(-right, 0) : size - max(right, 0)]
            shared[phase, (down, right)] = float(np.sum(mine * theirs))
    return {phase: float(np.vdot(w, w)) for phase, w in weights.items()}, shared


def _neighbours(values: FloatArray, places: Sequence[tuple[int, int]]) -> FloatArray:
    """Sum over each pixel's neighbours at `places`, (rows down, columns to the right), with zeros beyond the border."""
    rows, cols = values.shape
    wide = np.pad(values, 2)
    return np.sum([wide[2 + down : 2 + down + rows, 2 + right : 2 + right + cols] for down, right in places], axis=0)


def _phase_of(cfa: Cfa) -> dict[str, tuple[int, int]]:
    """(row, column) of each plane in the period of the mosaic."""
    index = np.arange(4).reshape(2, 2)
    return {name: divmod(int(plane[0, 0]), 2) for name, plane in mosaic.planes(index, cfa).items()}


NOISE_NEIGHBOURS = Measurement(
    "noise_neighbours",
    title="noise correlation of neighbouring pixels",
    order=230,
    axis="level",
    unit="DN",
    make=measure_noise_neighbours,
    quantity="correlation",
    of_variances=True,
)
NOISE_TONES = Measurement(
    "noise_tones",
    title="tones in the noise of dark frames",
    order=185,
    axis="level",
    unit="DN",
    make=measure_noise_tones,
    quantity="share of the temporal variance",
    of_variances=True,
)
