"""The correlation of the temporal noise of neighbouring pixels, in the dark and in uniform light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from lab.diagnose.measurements.block import LEVEL_REACH, Block, Label, Measurement, Prediction
from lab.diagnose.measurements.temporal_noise import PAIRS, dark_repeats, flat_repeats
from lab.errors import NotDetermined
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
        kernel = model.filter_kernel()
        if kernel is None and not model.shares_shot_noise:
            return Prediction(np.zeros(len(value)), {})
        parts = []
        for r in points:
            gain = noise.gain * r.gain
            electrons = np.array([max(s, 0.0) / gain for s in r.signal.values()])
            read = max(noise.read_dn**2 - 1.0 / 12.0, 0.1 * noise.read_dn**2) / noise.gain**2
            parts.append(
                correlations(
                    camera.cfa,
                    list(r.signal),
                    np.maximum(model.shot_e2(electrons), 0.0),
                    solve_passed_share(model.neighbour_correlation(electrons)),
                    read,
                    1.0 / 12.0 / gain**2,
                    kernel,
                )
            )
        return Prediction(np.concatenate(parts), {})

    return Block(
        measurement=NOISE_NEIGHBOURS, reach=LEVEL_REACH, along=np.repeat(np.log(level), len(names)),
        value=value, covariance=covariance + CORRELATION_FLOOR**2 * np.eye(len(value)),
        labels=tuple(Label(r.level if bright else 0.0, name, f"{r.exposure_s:.4g} s" if bright else f"dark, {r.exposure_s:.4g} s", r.captures, r.held_out)  # noqa: E501
                     for r, bright in zip(points, lit, strict=True) for name in names),
        reads=frozenset({"signal.filters", "charge.correlation"}), predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def correlations(
    cfa: Cfa,
    planes: Sequence[str],
    shot_e2: FloatArray,
    share: FloatArray,
    read_e2: float,
    rounding_e2: float,
    kernel: FloatArray | None,
) -> FloatArray:
    """Predicted correlations by `PAIRS` in uniform light, (6,): means over the phases of the mosaic.

    `shot_e2` and `share` (planes,): variance of the shot noise, and share of each neighbour's departure from its mean
    that a pixel takes over. Read noise (`read_e2`) is independent. `kernel` filters both within a plane. Rounding
    (`rounding_e2`) is added last and is independent.
    """
    period = 1 if cfa == "MONO" else 2
    at = dict.fromkeys(planes, (0, 0)) if period == 1 else _phase_of(cfa)
    variance, taken = np.zeros((period, period)), np.zeros((period, period))
    for name, v, g in zip(planes, shot_e2, share, strict=True):
        variance[at[name]], taken[at[name]] = v, g
    taps = np.ones((1, 1)) if kernel is None else kernel
    half = taps.shape[0] // 2 * period + 1
    reach = half + 2
    size = 2 * reach + 1
    offset = np.arange(size) - reach
    found = np.zeros(len(PAIRS))
    weights: dict[tuple[int, int], FloatArray] = {}  # (shot and read noise, size, size)
    for phase in np.ndindex(period, period):
        row, col = (phase[0] + offset) % period, (phase[1] + offset) % period
        own, g = variance[np.ix_(row, col)], taken[np.ix_(row, col)]
        shifted = _four_neighbours(own)
        norm = 1.0 / np.sqrt(1.0 + np.square(g) * shifted / np.maximum(own, 1e-12))
        read = np.zeros((size, size))
        middle = taps.shape[0] // 2
        for (i, j), tap in np.ndenumerate(taps):
            read[reach + (i - middle) * period, reach + (j - middle) * period] = tap
        shot = read * norm
        passed = read * norm * g
        shot = shot + _four_neighbours(passed)
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


def _four_neighbours(values: FloatArray) -> FloatArray:
    """Sum of each pixel's four neighbours, with zeros beyond the border."""
    wide = np.zeros((values.shape[0] + 2, values.shape[1] + 2))
    wide[1:-1, 1:-1] = values
    return np.asarray(wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:])


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
