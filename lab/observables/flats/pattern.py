"""The fixed pattern of flats by spatial frequency, and that of near-infrared light beside it: rings and fringes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import polygamma

from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of
from lab.observables.flats.images import LEAST_SIGNAL, dark_level_dn, flats
from lab.observables.noise.line_spectra import log_mean_bias
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import PATTERNS, acting
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

#: Bands of spatial frequency, cycles a pixel of a colour's plane; and that of the pixels' own pattern and noise.
BAND_EDGES = 0.03, 0.05, 0.08, 0.125, 0.2
OWN_BAND = 0.25, 0.45
LEAST_PX = 96  # pixels of a plane a side: the lowest band holds ten frequencies
MOST_PX = 768  # of the middle of a plane that are read
#: Sets of effects whose patterns are kept: a refit varies other effects' parameters beside the same pattern.
CACHED_PATTERNS = 64
#: Degree in row and column of the surface that is taken out as the light's.
LIGHT_DEGREE = 3
#: Shortest wavelength at which a thinned sensor is an etalon, nm; and how many are read, the longest ones.
INFRARED_NM, MOST_WAVELENGTHS = 680.0, 6
#: Relative standard deviation of a band's power: a healthy pattern isn't exactly white.
POWER_FLOOR = 0.1
#: Standard deviation of the logarithm of what dust and uneven light make of the lowest band's power. It falls with the
#: third power of the frequency.
DUST_STD, DUST_POWER = 2.0, 3.0
#: Standard deviation of the share of charge or signal that each next pixel takes: it takes fine detail away.
SHARED_STD = 0.05
#: Chance of white noise, in each band, of a frequency's power from which on it counts as a tone, and the frequencies to
#: either side that its window takes. Striped sensitivities, of one frequency and direction, are no rings.
TONE_CHANCE, TONE_REACH, MOST_TONES = 1e-4, 2, 1
#: Correlation of the amplitudes of white noise in a Hann window by their distance, in cycles a frame.
WINDOW_CORRELATION = {-2: 1.0 / 6.0, -1: -2.0 / 3.0, 0: 1.0, 1: -2.0 / 3.0, 2: 1.0 / 6.0}


@dataclass(frozen=True)
class _PlanePart:
    """Flats in one light, seen or held out. Powers are by band, over the mean signal's square."""

    light: Spectrum | None
    reference: Spectrum | None  # light of the flats by which it is divided; None: by none
    name: str
    held_out: bool
    captures: tuple[str, ...]
    power: FloatArray  # (bands,)
    own: float  # of the pixels' own pattern and noise
    fixed_share: float  # of `own` that isn't noise
    shape: tuple[int, int]  # of the plane
    used: NDArray[np.bool_]  # frequencies of `rfft2` that aren't tones


def measure_flat_pattern(dataset: Dataset) -> Observable:
    """Power of the flats' mean image by band of spatial frequency over that of its pixels, ln: of all flats, and of
    each near-infrared narrowband light over the flats' image.

    0 where pixels are independent. Rows' and columns' means and a polynomial surface are taken out: gains of lines and
    shading have measurements of their own. Nuisance parameters: dust and uneven light, and charge that neighbours
    share. Raises NotDetermined without unclipped flats, and for frames that are too small.
    """
    _, images = dataset.once(flats)
    if not images:
        raise NotDetermined("flat_pattern", "no unclipped flat captures")
    step = mosaic.step(dataset.camera.cfa)
    side_px = min(dataset.camera.rows, dataset.camera.cols) // step
    if side_px < LEAST_PX:
        raise NotDetermined(
            "flat_pattern",
            f"planes of {side_px} px: patterns over tens of pixels are seen from {LEAST_PX} px a side on",
        )
    parts = [*_of_flats(dataset), *_of_infrared(dataset)]
    band = np.array([np.sqrt(low * high) for low, high in pairwise(BAND_EDGES)])
    bias = [_log_bias(part.shape) for part in parts]
    value = np.concatenate([np.log(part.power / part.own) - b for part, b in zip(parts, bias, strict=True)])

    @lru_cache(maxsize=CACHED_PATTERNS)
    def of_patterns(patterned: Effects) -> list[tuple[FloatArray, float]]:
        return _pattern_powers(dataset, parts, patterned)

    none = [(np.zeros(len(band)), 0.0)] * len(parts)

    def predict(effects: Effects) -> Prediction:
        patterned = acting(effects, PATTERNS)
        ratio, dust, shared = [], [], []
        for part, (power, own) in zip(parts, of_patterns(patterned) if patterned else none, strict=True):
            bare = max(part.own - own, 0.05 * part.own)
            ratio.append((bare + power) / (bare + own))
            dust.append(DUST_STD * (band[0] / band) ** DUST_POWER / ratio[-1] * (part.reference is None))
            # by shares c of four neighbours the transfer is 1 - 2 c (2 - cos - cos)
            shared.append(4.0 * SHARED_STD * (_roughness(np.sqrt(OWN_BAND[0] * OWN_BAND[1])) - _roughness(band)))
        jacobian = {"flat_pattern:dust": np.concatenate(dust), "flat_pattern:shared": np.concatenate(shared)}
        return Prediction(np.log(np.concatenate(ratio)), jacobian)

    return Observable(
        measurement=FLAT_PATTERN, reach=0.05, value=value, covariance=_covariance(parts),
        labels=tuple(Label(float(f), "all", part.name, part.captures, part.held_out) for part in parts for f in band),
        reads=PATTERNS, predict=predict, scale=np.ones(len(value)),
        along=np.log(np.tile(band, len(parts))),
    )  # fmt: skip


def _roughness(frequency: FloatArray | float) -> FloatArray:
    """Mean of 2 - cos 2 pi fx - cos 2 pi fy over directions, to the fourth order of the frequency f."""
    square = np.square(2.0 * np.pi * np.asarray(frequency))
    return np.asarray(square / 2.0 - square**2 / 32.0)


def _of_flats(dataset: Dataset) -> list[_PlanePart]:
    levels, images = dataset.once(flats)
    found = []
    for held_out, (image, noise) in sorted(images.items()):
        captures = [c for level in levels if level.held_out == held_out for c in level.captures]
        plane = _plane(dataset, image)
        used = _without_tones(plane)
        power, own = _powers(plane, used)
        step = mosaic.step(dataset.camera.cfa)
        fixed = float(np.clip(1.0 - noise / step**2 / max(own, 1e-30), 0.0, 1.0))
        light = _light_of(dataset, captures[0])
        name = "all flats"
        names = tuple(c.id for c in captures)
        found.append(_PlanePart(light, None, name, held_out, names, power, own, fixed, plane.shape, used))
    return found


def _of_infrared(dataset: Dataset) -> list[_PlanePart]:
    """Return narrowband flats of the longest wavelengths over the mean image of all flats, in which the pixels' own
    sensitivities cancel."""
    _, images = dataset.once(flats)
    if False not in images:
        return []
    every = dataset.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s))
    lit = [g for g in every if g[0].wavelength_nm >= INFRARED_NM and all(_is_bright(dataset, c) for c in g)]
    groups = sorted(lit, key=lambda g: -g[0].wavelength_nm)[:MOST_WAVELENGTHS]
    reference = np.maximum(images[False][0], 0.1)
    first = next(level.captures[0] for level in dataset.once(flats)[0] if not level.held_out)
    found = []
    for index, group in enumerate(groups):
        out = held_out_of(group, index, len(groups))
        for held_out in (False, True):
            captures = [c for c in group if (c.id in out) == held_out]
            if not captures:
                continue
            frames = (np.asarray(dataset.recordings.frame(c), float) - dark_level_dn(dataset, c) for c in captures)
            plane = _plane(dataset, sum(frames) / len(captures) / reference)
            used = np.ones((plane.shape[0], plane.shape[1] // 2 + 1), bool)
            power, own = _powers(plane, used)
            light, names = dataset.spectrum(captures[0].radiance), tuple(c.id for c in captures)
            name = f"{captures[0].wavelength_nm:g} nm over all flats"
            beside = _light_of(dataset, first)
            found.append(_PlanePart(light, beside, name, held_out, names, power, own, 0.0, plane.shape, used))
    return found


def _is_bright(dataset: Dataset, capture: Any) -> bool:
    means = dataset.levels(capture).mean.values()
    least = LEAST_SIGNAL * dataset.noise.read_dn + dark_level_dn(dataset, capture)
    return all(mean is not None and mean > least for mean in means)


def _light_of(dataset: Dataset, capture: Any) -> Spectrum | None:
    if capture.radiance is not None:
        return dataset.spectrum(capture.radiance)
    if capture.wavelength_nm is None:
        return None
    near = capture.wavelength_nm + np.array([-1.0, 0.0, 1.0])
    return Spectrum.of(near, np.array([0.0, 1.0, 0.0]))


def _plane(dataset: Dataset, image: FloatArray) -> FloatArray:
    """Mean over the cell of the mosaic of an image, each plane over its mean, in the middle of the frame."""
    planes = mosaic.planes(image, dataset.camera.cfa).values()
    rows, cols = (min(n) for n in zip(*(p.shape for p in planes), strict=True))
    mean: FloatArray = np.mean([p[:rows, :cols] / float(np.mean(p, dtype=float)) for p in planes], axis=0, dtype=float)
    return mean[_middle(rows), _middle(cols)]


def _middle(count: int) -> slice:
    size = min(count, MOST_PX)
    return slice((count - size) // 2, (count - size) // 2 + size)


def _spectrum(plane: FloatArray) -> FloatArray:
    """Power of a plane by frequency (`rfft2`), the variance of a pixel where pixels are independent; without surface
    and means of lines."""
    down, across = (np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, n), LIGHT_DEGREE) for n in plane.shape)
    down, across = (np.linalg.qr(base)[0] for base in (down, across))
    rest = plane - down @ (down.T @ plane @ across) @ across.T
    rest = rest - rest.mean(axis=0) - rest.mean(axis=1)[:, None] + rest.mean()
    window = np.multiply.outer(*(1.0 - np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n) for n in plane.shape))
    window /= np.sqrt(np.mean(np.square(window)))
    return np.asarray(np.square(np.abs(np.fft.rfft2(rest * window))) / rest.size)


def _without_tones(plane: FloatArray) -> NDArray[np.bool_]:
    """Return which frequencies are no tones: in each band, those are left out whose power exceeds what white noise of
    the band's median has in one of 1 / `TONE_CHANCE` bands. Where there are more than `MOST_TONES`, as rings have
    waves of many directions, none are."""
    power = _spectrum(plane)
    used = np.ones(power.shape, bool)
    for band in _frequencies(plane.shape):
        left = used.copy()
        for _ in range(MOST_TONES + 1):
            here = band & left
            limit = np.median(power[here]) / np.log(2.0) * np.log(np.count_nonzero(here) / TONE_CHANCE)
            row, col = np.unravel_index(int(np.argmax(np.where(here, power, 0.0))), power.shape)
            if power[row, col] <= limit:
                used = left
                break
            rows = np.arange(row - TONE_REACH, row + TONE_REACH + 1) % power.shape[0]
            left[rows, max(int(col) - TONE_REACH, 0) : int(col) + TONE_REACH + 1] = False
    return used


def _powers(plane: FloatArray, used: NDArray[np.bool_]) -> tuple[FloatArray, float]:
    """Mean power in each of the bands, and in that of the pixels' own pattern, of the frequencies that are used: the
    variance of a pixel where pixels are independent."""
    power = _spectrum(plane)
    *bands, own = (float(power[band & used].mean()) for band in _frequencies(plane.shape))
    return np.array(bands), own


@cache
def _frequencies(shape: tuple[int, int]) -> list[NDArray[np.bool_]]:
    """Which frequencies of `rfft2` are in each of the bands, and in that of the pixels' own pattern, off the axes."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    radius = np.where((np.abs(fy) * shape[0] > 1.5) & (fx * shape[1] > 1.5), np.hypot(fy, fx), 0.0)
    return [(radius >= low) & (radius < high) for low, high in (*pairwise(BAND_EDGES), OWN_BAND)]


@cache
def _modes(shape: tuple[int, int]) -> FloatArray:
    """How many independent frequencies each band and the pixels' own are worth: n^2 over the sum of the squared
    correlations of all pairs of its n frequencies, as of `line_gains`."""
    found = []
    for band in _frequencies(shape):
        pairs = 0.0
        for down, a in WINDOW_CORRELATION.items():
            for across, b in WINDOW_CORRELATION.items():
                other = np.roll(band, down, axis=0)
                here = slice(max(across, 0), band.shape[1] + min(across, 0))
                there = slice(max(-across, 0), band.shape[1] + min(-across, 0))
                pairs += float(np.count_nonzero(band[:, here] & other[:, there])) * (a * b) ** 2
        found.append(max(np.count_nonzero(band) ** 2 / pairs, 1.0))
    return np.array(found)


def _log_bias(shape: tuple[int, int]) -> FloatArray:
    modes = _modes(shape)
    return np.asarray(log_mean_bias(modes[:-1]) - log_mean_bias(modes[-1:]))


def _pattern_powers(dataset: Dataset, parts: Sequence[_PlanePart], effects: Effects) -> list[tuple[FloatArray, float]]:
    """Power of the pattern that effects leave in the flats of each part's light, as of `_powers`."""
    camera = dataset.camera
    step, model = mosaic.step(camera.cfa), Uniform(camera, effects)
    row, col = (step * (np.arange(n // step, dtype=np.float64) + 0.5) - 0.5 for n in (camera.rows, camera.cols))
    x_um: FloatArray = (col[None, :] - 0.5 * (camera.cols - 1)) * camera.pixel_pitch_um
    y_um: FloatArray = (row[:, None] - 0.5 * (camera.rows - 1)) * camera.pixel_pitch_um
    known = [c for c in camera.channels if c in camera.quantum_efficiency]

    @cache
    def of_light(light: Spectrum, kind: str) -> list[FloatArray]:
        found = (model.pattern(channel, light, kind, x_um, y_um) for channel in known)
        return [one[_middle(len(row)), _middle(len(col))] for one in found]

    found = []
    for part in parts:
        if part.light is None or not known:
            found.append((np.zeros(len(BAND_EDGES) - 1), 0.0))
        elif part.reference is None:
            found.append(_powers(np.mean(of_light(part.light, "flat"), axis=0), part.used))
        else:
            both = zip(of_light(part.light, "narrowband"), of_light(part.reference, "flat"), strict=True)
            found.append(_powers(np.mean([one / other for one, other in both], axis=0), part.used))
    return found


def _covariance(parts: Sequence[_PlanePart]) -> FloatArray:
    """Covariance of ln(power / own) of all parts. A part's bands have the pixels' own power in common; seen and
    held-out flats have the same pattern, and noise of their own."""
    bands = len(BAND_EDGES) - 1
    blocks = []
    for part in parts:
        scatter = polygamma(1, _modes(part.shape))
        blocks.append(np.diag(scatter[:-1] + POWER_FLOOR**2) + scatter[-1])
    covariance = np.zeros((bands * len(parts), bands * len(parts)))
    for a, one in enumerate(parts):
        for b, other in enumerate(parts[: a + 1]):
            at, there = slice(a * bands, (a + 1) * bands), slice(b * bands, (b + 1) * bands)
            if a == b:
                covariance[at, there] = blocks[a]
            elif one.name == other.name:
                both = one.fixed_share * other.fixed_share * blocks[a]
                covariance[at, there], covariance[there, at] = both, both.T
    return covariance


FLAT_PATTERN = Measurement(
    "flat_pattern",
    title="pattern of flat fields by spatial frequency",
    order=267,
    axis="spatial_frequency",
    unit="cy/px",
    make=measure_flat_pattern,
    quantity="power over single pixels', ln",
    conditions="light",
)
