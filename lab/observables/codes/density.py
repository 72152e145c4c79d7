"""The code-density test of the converter: the histogram of codes in uniform light.

Noise and shading make the histogram of many frames smooth on the scale of the noise's standard deviation at each level.
Structure on a finer scale comes from the converter (differential nonlinearity), or from processing of the codes after
it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import block_diag

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.observables.codes.even_light import EvenLight, ExpectedCounts, PatternSum, PlaneCounts
from lab.observables.codes.landings import landings
from lab.observables.dataset import CLIPPED_SHARE, Dataset, held_out_flats, held_out_of
from lab.observables.observable import Label, Measurement, Observable, Prediction
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray

#: Step of the codes, DN, from which on they were shifted or scaled: one stuck bit gives 2, two stuck bits are taken
#: as a shift.
SHIFTED_FROM = 4
LEAST_NOISE = 3.0  # standard deviation of the light's noise, codes; below, noise doesn't smooth the histogram
LEAST_COUNT = 30.0  # of a code that is looked at
WIDEST = 24  # codes on either side of a smooth curve
DEGREE = 4
LEAST_CODES = 24
PLACES = 128  # parts of the converter's range, at whose borders steps are looked for
LEAST_SPACING = 4  # codes from one place to the next
FAR = 1.3  # of the noise's standard deviation: distance over which the curve beside a place is fitted
DEGREE_BESIDE = 1
STEP_COUNT = 3.0  # of each code about a place; the sum over a place has a hundred times as many
COMB_FLOOR = 3e-4
VARIANCE_FLOOR = 0.03  # of a chi2's number of codes
#: Frequencies of the combs, cycles a code.
COMBS = (1 / 2, 3 / 8, 1 / 4, 1 / 8)
PARTS = 4  # of the range of codes, each with a chi2 of its own


@dataclass(frozen=True)
class CodeHistogram:
    """The histogram over the codes that can be tested; arrays are (codes,)."""

    first: int  # the lowest code
    count: FloatArray  # of pixels
    expected: FloatArray  # counts by the light and its noise, for an ideal converter
    smooth: FloatArray  # smoothed counts
    rough: sparse.csr_array  # (codes, codes): counts -> residuals, the identity less the smoothing filter
    noise: FloatArray  # standard deviation of the light's noise, codes
    used: np.ndarray  # mask: counted often enough, and all neighbours of the filter present


def measure_code_density(dataset: Dataset) -> Observable:
    """Code-density test of all uniform light: steps (DN) by the code, combs of a few codes' period, and the variance of
    the counts about a smooth curve."""
    counts = dataset.once(counted)
    labels: list[Label] = []
    places: list[tuple[float, float]] = []
    sets: dict[bool, tuple[CodeHistogram, FloatArray, ExpectedCounts, list[_Part]]] = {}
    values, covariances, scales = [], [], []
    for held_out in (False, True):
        codes = prepared(dataset, counts[held_out])
        if codes is None:
            continue
        (steps, boundaries), parts = _steps(dataset, codes), _parts(codes)
        combs, names = _combs(codes)
        residual = codes.rough @ codes.count
        values += [
            steps @ codes.count,
            combs @ codes.count,
            np.array([p.excess(residual) - p.number / p.chi2_std for p in parts]),
        ]
        # unequal codes show in proportion to the number of pixels counted: seen and held-out frames have different ones
        scales += [np.ones(len(steps) + len(combs)), np.array([p.ofwidths for p in parts])]
        linear = np.vstack([steps, combs])
        floor = np.concatenate([np.zeros(len(steps)), np.full(len(combs), COMB_FLOOR)])
        light = ExpectedCounts.of(counts[held_out].planes, codes.first, len(codes.count))
        covariances += [
            _covariance(linear, codes, counts[held_out], light) + np.diag(np.square(floor)),
            np.diag([1.0 + (VARIANCE_FLOOR * p.number / p.chi2_std) ** 2 for p in parts]),
        ]
        members = tuple(counts[held_out].captures)
        labels += [
            Label(float(codes.first + b), "step", f"code {codes.first + b}", members, held_out) for b in boundaries
        ]
        labels += [Label(x, "comb", words, members, held_out) for x, words in names]
        for p in parts:
            low, high = codes.first + p.at.start, codes.first + p.at.stop - 1
            labels.append(Label(0.5 * (low + high), "variance", f"codes {low} to {high}", members, held_out))
        # discrepancies of combs: independent between periods and phases, the same for seen and held-out frames
        far = 10.0 * dataset.camera.white_level_dn
        places += [(float(codes.first + b), 0.0) for b in boundaries]
        places += [(0.0, far * k) for k in range(len(names))]
        places += [(label.x, 0.0) for label in labels[len(places) :]]
        sets[held_out] = codes, linear, light, parts
    if not labels:
        raise NotDetermined(
            "code_density", f"no even light over {LEAST_CODES} codes and more whose noise exceeds {LEAST_NOISE:g} codes"
        )

    def predict(effects: Effects) -> Prediction:
        found: list[FloatArray] = []
        scatter: dict[str, tuple[int, float]] = {}
        for held_out, (codes, linear, light, parts) in sets.items():
            change = light.change(landings(codes.first, len(codes.count), effects, dataset))
            moved = codes.rough @ change
            excess = np.array([p.excess(moved) for p in parts])
            at = sum(map(len, found)) + len(linear)
            found += [linear @ change, excess]
            for k in np.flatnonzero(excess > 0.0):
                scatter[f"codes:{held_out}:{k}"] = at + int(k), parts[k].scatter(float(excess[k]))
        mean = np.concatenate(found)
        return Prediction(mean, {name: std * (np.arange(len(mean)) == i) for name, (i, std) in scatter.items()})

    return Observable(
        measurement=CODE_DENSITY, reach=0.1 * dataset.camera.white_level_dn, value=np.concatenate(values),
        covariance=block_diag(*covariances), labels=tuple(labels), reads=frozenset({"codes.codes"}), predict=predict,
        scale=np.concatenate(scales),
        along=np.array(places),
    )  # fmt: skip


@dataclass(frozen=True)
class _Counts:
    """Counts of every code in some frames, (white level + 1,), and the counts that light and noise give an ideal
    converter; `planes`: those of each plane of the mosaic in each setting."""

    count: FloatArray
    expected: FloatArray
    captures: list[str]
    planes: list[PlaneCounts]

    def add(self, dataset: Dataset, capture: Any) -> None:
        """Add the codes of a capture's frame."""
        codes = dataset.recordings.codes(capture).every
        inside = codes.code_dn < len(self.count)
        self.count[codes.code_dn[inside]] += codes.number[inside]
        self.captures.append(capture.id)


def counted(dataset: Dataset) -> dict[bool, _Counts]:
    """Counts of all flat and narrowband frames without gain in dB: seen (False) and held out (True). Raises
    NotDetermined where codes lie `SHIFTED_FROM` or more apart."""
    if dataset.step_dn >= SHIFTED_FROM:
        raise NotDetermined(
            "code_density",
            f"codes lie {dataset.step_dn:.5g} DN apart, as those of fewer bits that were shifted or scaled: their "
            "steps aren't judged; write the frames as they left the converter",
        )
    size = int(dataset.camera.white_level_dn) + 1
    counts = {out: _Counts(np.zeros(size), np.zeros(size), [], []) for out in (False, True)}
    settings, out = _settings(dataset)
    patterns: dict[_Plane, PatternSum] = {}
    for capture in (capture for setting in settings for capture in setting):
        for key, plane in _planes(dataset, capture):
            pattern = patterns.setdefault(key, PatternSum())
            if _clipped_share(dataset, plane) < CLIPPED_SHARE:
                pattern.add(plane, dataset.noise.black)
    sensitivity = {key: pattern.sensitivity() for key, pattern in patterns.items()}
    gain = dataset.noise.gain if dataset.noise.gain_is_known else None
    for setting in settings:
        lights: dict[tuple[bool, _Plane], EvenLight] = {}
        for capture in setting:
            is_out = capture.id in out
            counts[is_out].add(dataset, capture)
            for key, plane in _planes(dataset, capture):
                own = sensitivity[key] if _clipped_share(dataset, plane) < 0.5 else 0.0
                lights.setdefault((is_out, key), EvenLight(dataset.noise.black)).add(plane, own)
        for (is_out, _), light in lights.items():
            plane_counts = light.counts(gain, size)
            counts[is_out].expected[:] += plane_counts.expected()
            counts[is_out].planes.append(plane_counts)
    return counts


def _settings(dataset: Dataset) -> tuple[list[list[Any]], set[str]]:
    """Return the captures of even light without gain in dB, by setting, and the ids of those held out."""
    flats = dataset.flat_levels()
    narrow = dataset.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    out = set(dataset.once(held_out_flats))
    out |= set().union(*(held_out_of(g, i, len(narrow)) for i, g in enumerate(narrow)))
    settings = ([capture for capture in group if not capture.gain_db] for group in (*flats, *narrow))
    return [setting for setting in settings if setting], out


_Plane = tuple[str, tuple[int, ...]]  # name of a plane of the mosaic, and its shape


def _planes(dataset: Dataset, capture: Any) -> Iterator[tuple[_Plane, FloatArray]]:
    """Yield the planes of a capture's frame."""
    for name, plane in mosaic.planes(dataset.recordings.frame(capture), dataset.camera.cfa).items():
        yield (name, plane.shape), np.asarray(plane, np.float32)


def _clipped_share(dataset: Dataset, plane: FloatArray) -> float:
    """Share of a plane's pixels at the clipping level, which all sensitivities reach alike."""
    return float(np.mean(plane >= dataset.saturation_dn))


def counted_in_all(dataset: Dataset) -> dict[bool, _Counts]:
    """Counts of `counted`, and of all other frames with light, without what their light gives an ideal converter.

    Their histogram is as smooth by the noise of the light as that of even light. Of each kind every third capture is
    held out.
    """
    found = {}
    for out, even in dataset.once(counted).items():
        found[out] = _Counts(even.count.copy(), np.zeros(len(even.count)), list(even.captures), [])
    number: dict[str, int] = {}
    for capture in dataset.recordings.captures(side=dataset.side):
        if capture.kind in {"dark", "flat", "narrowband"} or getattr(capture, "gain_db", None):
            continue
        number[capture.kind] = number.get(capture.kind, -1) + 1
        found[number[capture.kind] % 3 == 1].add(dataset, capture)
    return found


def prepared(dataset: Dataset, counts: _Counts) -> CodeHistogram | None:
    """Return the histogram over the usable codes, None where they are too few."""
    level = np.arange(len(counts.count), dtype=float)
    noise = np.sqrt(np.maximum(dataset.noise.gain * (level - dataset.noise.black), 0.0) + dataset.noise.read_dn**2)
    high = min(float(dataset.saturation_dn), float(len(level) - 1))
    usable = (noise >= LEAST_NOISE) & (level < high - 6.0 * noise)
    if usable.sum() < LEAST_CODES:
        return None
    first, last = int(np.flatnonzero(usable)[0]), int(np.flatnonzero(usable)[-1])
    count, expected, noise = (a[first : last + 1] for a in (counts.count, counts.expected, noise))
    half = np.clip(noise.astype(int), 3, WIDEST)
    index = np.arange(len(count))
    inside = (index >= half) & (index < len(count) - half)
    weights, columns, rows = [], [], []
    for width in np.unique(half):
        at = index[inside & (half == width)]
        own = -_smoothing(int(width))
        own[width] += 1.0
        rows.append(np.repeat(at, len(own)))
        columns.append((at[:, None] + np.arange(-width, width + 1)).ravel())
        weights.append(np.tile(own, len(at)))
    if not rows:
        return None
    rough = sparse.csr_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(len(count), len(count))
    )
    smooth = np.maximum(count - rough @ count, 0.0)
    used = inside & (smooth >= LEAST_COUNT)
    if used.sum() < LEAST_CODES:
        return None
    return CodeHistogram(first, count, expected, smooth, rough, noise, used)


@cache
def _smoothing(half: int) -> FloatArray:
    """Weights (2 half + 1,) of the Savitzky-Golay filter: the value in the middle of the polynomial of degree `DEGREE`
    that least squares fit to 2 half + 1 values."""
    x = np.arange(-half, half + 1) / half
    return np.asarray(np.linalg.pinv(np.vander(x, DEGREE + 1, increasing=True))[0])


def _covariance(linear: FloatArray, codes: CodeHistogram, counts: _Counts, light: ExpectedCounts) -> FloatArray:
    """Return the covariance (m, m) of `linear` (m, codes) @ counts less what is expected.

    Each pixel has one code, with the probabilities of its level: the counts are a sum of multinomial ones. What is
    expected has its local means and each plane's mean square from the same pixels: it follows the counts of
    neighbouring levels with their mean, and those of a plane with their mean square. These parts of the counts' noise
    cancel."""
    covariance = (linear * np.maximum(codes.expected, 1.0)) @ linear.T
    taken = [linear @ plane.scatter(codes.first, len(codes.count)).T for plane in counts.planes]
    table = np.concatenate([*taken, *(linear @ part for part in light.followed())], axis=1)
    return np.asarray(covariance - table @ table.T)


def _combs(codes: CodeHistogram) -> tuple[FloatArray, list[tuple[float, str]]]:
    """Weights (combs, codes) of the counts that give the combs' amplitudes relative to the mean count, and (mean code,
    words) of each.

    For every frequency of `COMBS`: the cosine and, below 1/2 cycle a code, the sine part of the residuals' Fourier sum.
    """
    index = np.arange(len(codes.count))
    table, names = [], []
    for f in COMBS:
        use = codes.used & (codes.noise >= max(LEAST_NOISE, 1.2 / f))
        total = float(codes.smooth[use].sum())
        if use.sum() < LEAST_CODES:
            continue
        for turn in (0.0, 0.25) if f < 0.5 else (0.0,):
            wave = np.cos(2.0 * np.pi * (f * (index + codes.first) - turn)) * use
            table.append(2.0 / total * (codes.rough.T @ wave))
            names.append((codes.first + float(index[use].mean()), f"every {1 / f:.3g} codes"))
    return np.array(table).reshape(len(table), len(index)), names


def _spacing(dataset: Dataset) -> int:
    """Codes from one place to the next."""
    return max(round(2.0**dataset.camera.bit_depth / PLACES), LEAST_SPACING)


def _steps(dataset: Dataset, codes: CodeHistogram) -> tuple[FloatArray, list[int]]:
    """Weights of the counts that give how many codes' worth is missing about each of `PLACES` parts of the converter's
    range, and these codes.

    Codes count the less, the further they are from the place, and not at all from the next place on: what is missing
    anywhere is shared by the two places beside it. It is missing against `expected` and the parabola that it lacks on
    either side of both neighbours."""
    spacing = _spacing(dataset)
    table, at = [], []
    for k in range(1, int(2.0**dataset.camera.bit_depth / spacing)):
        place = k * spacing - codes.first
        if not 0 <= place < len(codes.count):
            continue
        far = max(8, round(FAR * float(codes.noise[place])))
        low, high = place - spacing - far, place + spacing + far
        if low < 0 or high > len(codes.count) or codes.expected[low:high].min() < STEP_COUNT:
            continue
        x = np.arange(low, high) - place + 0.5
        near = np.maximum(1.0 - np.abs(x) / spacing, 0.0)
        beside = np.minimum(1.0 - near, np.maximum((spacing + far - np.abs(x)) / far, 0.0))
        basis = np.vander(x / (spacing + far), DEGREE_BESIDE + 1, increasing=True)
        expected = codes.expected[low:high]
        # the curve's coefficients are `of_counts` @ counts
        of_counts = np.linalg.solve((basis.T * (beside * expected)) @ basis, basis.T * beside)
        weights = np.zeros(len(codes.count))
        share = (near * expected) @ basis @ of_counts - near
        weights[low:high] = share * near.sum() / (near * expected).sum()
        table.append(weights)
        at.append(place)
    return np.array(table).reshape(len(table), len(codes.count)), at


@dataclass(frozen=True)
class _Part:
    """A part of the range of codes, whose residuals have one chi2."""

    at: slice  # its codes
    number: int  # of codes used
    variance: FloatArray  # of the residuals; infinite at codes that aren't used
    chi2_std: float  # standard deviation of the residuals' chi2
    ofwidths: float  # excess where the codes' widths have a relative variance of 1, independent of each other

    def excess(self, residual: FloatArray) -> float:
        """chi2 of the residuals (codes,) over its standard deviation."""
        return float(np.sum(np.square(residual[self.at]) / self.variance)) / self.chi2_std

    def scatter(self, excess: float) -> float:
        """Standard deviation of a predicted excess by the residuals' noise: chi2 of noncentrality l has the variance
        2 n + 4 l."""
        return float(np.sqrt(4.0 * excess / self.chi2_std))


def _parts(codes: CodeHistogram) -> list[_Part]:
    """Return the parts with codes enough. Var(chi2) = 2 n sum_k r_k^2 with the residuals' autocorrelation r of the
    smoothing filter."""
    square = codes.rough.power(2)
    variance = np.asarray(square @ np.maximum(codes.smooth, 1.0))
    unequal = np.asarray(square @ np.square(codes.smooth))
    found = []
    for part in np.array_split(np.flatnonzero(codes.used), PARTS):
        if len(part) < LEAST_CODES:
            continue
        at = slice(int(part[0]), int(part[-1]) + 1)
        kept = codes.used[at]
        row = codes.rough[[int(part[len(part) // 2])]].toarray().ravel()
        row = row[np.flatnonzero(row)]
        shared = np.correlate(row, row, mode="full") / float(row @ row)
        number = int(kept.sum())
        chi2_std = float(np.sqrt(2.0 * number * np.sum(shared**2)))
        ofwidths = float(np.sum(unequal[at][kept] / variance[at][kept])) / chi2_std
        found.append(_Part(at, number, np.where(kept, variance[at], np.inf), chi2_std, ofwidths))
    return found


CODE_DENSITY = Measurement(
    "code_density",
    title="code-density test",
    order=240,
    axis="level",
    unit="DN",
    make=measure_code_density,
    quantity="step, DN, or excess variance of counts",
)
