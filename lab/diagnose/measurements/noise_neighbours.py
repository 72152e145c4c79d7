"""The correlation of the temporal noise of neighbouring pixels, in the dark and in uniform light; and tones in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.ndimage import convolve1d

from lab.diagnose.measurements.block import LEVEL_REACH, Block, Label, Measurement, Prediction
from lab.diagnose.measurements.temporal_noise import PAIRS, dark_repeats, flat_repeats
from lab.errors import NotDetermined
from lab.measure.reads import READ_SPECTRUM
from lab.measure.study import Study
from sim.camera import Cfa
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.sensor.electrons import solve_passed_share
from sim.spectrum import FloatArray
from sim.uniform import Uniform

CORRELATION_FLOOR = 3e-4  # standard deviation of a correlation beside chance


def neighbour_block(study: Study) -> Block:
    """Correlation of the temporal noise of neighbouring pixels (`PAIRS`), by level of light and in the dark.

    It is 0 where pixels are independent, whatever gain, noise and level are. Raises NotDetermined without repeats whose
    noise exceeds a code.
    """
    points = [r for r in (*study.once(dark_repeats), *study.once(flat_repeats)) if np.all(np.isfinite(r.correlation))]
    if not points:
        raise NotDetermined(
            "noise_neighbours", "no repeats of dark or unclipped flat captures whose noise exceeds a code"
        )
    noise, camera = study.noise, study.camera
    lit = [r.level > max(20.0 * abs(noise.dark_dn_per_s) * r.exposure_s, 4.0 * noise.read_dn) for r in points]
    level = np.array([max(r.level, 1.0) for r in points])
    value = np.concatenate([r.correlation for r in points])
    covariance = block_diag(*(r.correlation_covariance for r in points))
    names = list(PAIRS)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(camera, effects)
        kernel, read_kernel = model.filter_kernel(), model.read_kernel()
        if kernel is None and read_kernel is None and not model.shares_shot_noise:
            return Prediction(np.zeros(len(value)), {})
        parts = []
        for r in points:
            gain, gain_db = noise.gain * r.gain, study.usual_gain_db + 20.0 * np.log10(r.gain)
            electrons = np.array([max(s, 0.0) / gain for s in r.signal.values()])
            read = max(noise.read_dn**2 - noise.quantisation_dn2, 0.1 * noise.read_dn**2) / noise.gain**2
            parts.append(
                correlations(
                    camera.cfa,
                    list(r.signal),
                    np.maximum(model.shot_e2(electrons, gain_db), 0.0),
                    solve_passed_share(model.neighbour_correlation(electrons)),
                    read,
                    noise.quantisation_dn2 / gain**2,
                    kernel,
                    read_kernel,
                )
            )
        return Prediction(np.concatenate(parts), {})

    return Block(
        measurement=NOISE_NEIGHBOURS, reach=LEVEL_REACH, along=np.repeat(np.log(level), len(names)),
        value=value, covariance=covariance + CORRELATION_FLOOR**2 * np.eye(len(value)),
        labels=tuple(Label(r.level if bright else 0.0, name, f"{r.exposure_s:.4g} s" if bright else f"dark, {r.exposure_s:.4g} s", r.captures, r.held_out)  # noqa: E501
                     for r, bright in zip(points, lit, strict=True) for name in names),
        reads=frozenset({"signal.filters", "charge.correlation"}) | READ_SPECTRUM, predict=predict,
        scale=np.ones(len(value)),
    )  # fmt: skip


def tone_block(study: Study) -> Block:
    """Share of tones in the variance of dark frames' temporal noise.

    Tones are frequencies across a frame that stand out of the noise by `temporal_noise.OUTLIER`, beside those of whole
    rows and columns: clocks of the read-out, of another phase in every frame. The standard deviation is the spread over
    settings, as phases are random (of a single one, its share), and that of one tone. Raises NotDetermined without
    repeated dark frames whose noise exceeds a code.
    """
    dark = [r for r in study.once(dark_repeats) if np.all(np.isfinite(r.correlation))]
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
    return Block(
        measurement=NOISE_TONES, reach=LEVEL_REACH, value=np.array(value), covariance=np.diag(variance),
        labels=tuple(labels), reads=frozenset(),
        predict=lambda effects: Prediction(np.zeros(len(value)), {}), scale=np.ones(len(value)),
    )  # fmt: skip


def correlations(
    cfa: Cfa,
    planes: Sequence[str],
    shot_e2: FloatArray,
    share: FloatArray,
    read_e2: float,
    rounding_e2: float,
    kernel: FloatArray | None,
    read_kernel: FloatArray | None = None,
) -> FloatArray:
    """Predicted correlations by `PAIRS` in uniform light, (6,): means over the phases of the mosaic.

    `shot_e2` (planes,): variance of the shot noise; `share` (2, planes): share of the departure from its mean of each
    neighbour in the row, and of each in the column, that a pixel takes over. Read noise (`read_e2`) is independent, or
    made of such noise by `read_kernel` (odd,) along the row. `kernel` filters both within a plane. Rounding
    (`rounding_e2`) is added last and is independent.
    """
    period = 1 if cfa == "MONO" else 2
    at = dict.fromkeys(planes, (0, 0)) if period == 1 else _phase_of(cfa)
    variance, taken = np.zeros((period, period)), np.zeros((2, period, period))
    for name, v, g in zip(planes, shot_e2, share.T, strict=True):
        variance[at[name]], taken[:, *at[name]] = v, g
    taps = np.ones((1, 1)) if kernel is None else kernel
    half = taps.shape[0] // 2 * period + 1
    reach = half + 2 + (0 if read_kernel is None else len(read_kernel) // 2)
    size = 2 * reach + 1
    offset = np.arange(size) - reach
    found = np.zeros(len(PAIRS))
    weights: dict[tuple[int, int], FloatArray] = {}  # (shot and read noise, size, size)
    for phase in np.ndindex(period, period):
        row, col = (phase[0] + offset) % period, (phase[1] + offset) % period
        own, shares = variance[np.ix_(row, col)], [g[np.ix_(row, col)] for g in taken]
        more = sum(np.square(g) * _neighbours(own, axis) for g, axis in zip(shares, (1, 0), strict=True))
        norm = 1.0 / np.sqrt(1.0 + more / np.maximum(own, 1e-12))
        read = np.zeros((size, size))
        middle = taps.shape[0] // 2
        for (i, j), tap in np.ndenumerate(taps):
            read[reach + (i - middle) * period, reach + (j - middle) * period] = tap
        shot = read * norm
        shot = shot + sum(_neighbours(read * norm * g, axis) for g, axis in zip(shares, (1, 0), strict=True))
        if read_kernel is not None:
            read = convolve1d(read, read_kernel, axis=1, mode="constant")
        weights[phase] = np.stack([shot * np.sqrt(own), read * np.sqrt(read_e2)])
    total = {p: float(np.vdot(w, w)) + rounding_e2 for p, w in weights.items()}
    for k, lags in enumerate(PAIRS.values()):
        parts = []
        for phase, here in weights.items():
            for down, right in lags:
                other = (phase[0] + down) % period, (phase[1] + right) % period
                mine = here[:, max(down, 0) : size + min(down, 0), max(right, 0) : size + min(right, 0)]
                theirs = weights[other][:, max(-down, 0) : size - max(down, 0), max(-right, 0) : size - max(right, 0)]
                parts.append(float(np.sum(mine * theirs)) / np.sqrt(total[phase] * total[other]))
        found[k] = np.mean(parts)
    return found


def _neighbours(values: FloatArray, axis: int) -> FloatArray:
    """Sum of each pixel's two neighbours along an axis, with zeros beyond the border."""
    wide = np.pad(values, 1)[:, 1:-1] if axis == 0 else np.pad(values, 1)[1:-1]
    return np.asarray(wide[:-2] + wide[2:] if axis == 0 else wide[:, :-2] + wide[:, 2:])


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
    make=neighbour_block,
    quantity="correlation",
    of_variances=True,
)
NOISE_TONES = Measurement(
    "noise_tones",
    title="tones in the noise of dark frames",
    order=185,
    axis="level",
    unit="DN",
    make=tone_block,
    quantity="share of the temporal variance",
    of_variances=True,
)
