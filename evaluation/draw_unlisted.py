"""The cases of a proof of discovery: cameras that conceal a law of no list, alone or beside a listed effect, and
healthy ones.

They are sealed and diagnosed as the cases of the other proof. What differs is what is drawn (`draw_unlisted`, here) and
what counts (`evaluation.unlisted`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from itertools import groupby
from math import gcd
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular

from evaluation.draw import Case, recording_set
from evaluation.independent_simulator import (
    LISTED,
    UNLISTED,
    WAVELENGTH_NM,
    ConcealedCamera,
    DrawnSession,
    Law,
    Plan,
    UnlistedLaw,
    record,
)
from evaluation.noncentrality import noncentrality, summaries
from evaluation.truth import SIZES, CaseTruth, Concealed
from lab.errors import InputError
from sim.spectrum import FloatArray

# ----------------------------------------------------------------------------------------------------------------------
# How plainly an unlisted law shows along its own axes: a non-centrality of the simulator's recordings, without
# summaries of any diagnosis.
#
# Recordings with and without the law are of one camera with the same noise, so that their difference is the law's
# alone. It is averaged over the classes of the law's declared axes (rows modulo 8, rings of the radius, captures,
# codes modulo 10, ...), which keeps all that the law does and little of the rounding. With d (n,) that change, C its
# covariance for one draw of the noise, and N (n, m) what camera, light and the listed effects may do along the same
# axes, the separability is
#
#     d1' (C + N N')^-1 d2
#
# with the columns of N one prior standard deviation each, of two draws of the noise, so that what rounding leaves
# cancels on average. C is known, for the camera is: shot and read noise, the fixed patterns of pixels, and what no
# light is steadier than (`LEVEL_STD`, `READING_STD`, `CURVE_STD`).


#: Relative standard deviations: of a level, common to its repeats; of a reading of narrowband light; of smooth errors
#: of the stated curves, and the length over which those are correlated.
LEVEL_STD, READING_STD, CURVE_STD, CURVE_NM = 1e-4, 1e-3, 3e-3, 60.0
RINGS, CELLS = 12, 8  # classes of the radius; of the place, along each of x and y
LEVEL_BINS = 12  # from black to full scale
FREE = 1e3  # variance of what is free in each block by itself, over the noise's
#: Prior standard deviations of what may stand beside a law.
LEVEL_DN, READ_DN2 = 1000.0, 10.0  # mean of a setting, variance of the read noise
FIELD_SHARE = 0.3  # what light and lens do over the field
BLACK_DN, BLACK_DN_PER_MIN, DARK_DN_PER_S = 10.0, 0.5, 20.0
DRIFT_PER_MIN, OFFSET_S = 0.01, 1e-4  # of the source, of the exposure
BEND_SHARE, GAIN_SHARE = 0.1, 0.2  # of square and cube of the response, at full scale; of the response itself
TILT, CURVE_BEND = 0.05, 0.01  # of a sensitivity curve, per 100 nm and its square
LINE_OFFSET_NM, LINE_WIDTH_NM2, LEAK_DN = 2.0, 10.0, 1.0  # of narrowband light
#: What captures of one setting have in common.
SETTING = ("kind", "exposure_s", "temperature_c", "radiance", "light_radiance", "angle_deg", "target", "wavelength_nm")


@dataclass(frozen=True)
class AxisTable:
    """Numbers of one recording in blocks of n that are independent of each other: their values (blocks, n), covariance
    (blocks, n, n), and what else may change them in all blocks alike (blocks, n, m), per prior standard deviation."""

    value: FloatArray
    covariance: FloatArray
    nuisance: FloatArray


Draws = Sequence[tuple[DrawnSession, DrawnSession]]


def separability_along(law: UnlistedLaw, camera: ConcealedCamera, draws: Draws) -> float:
    """Return the separability of a law. `camera`: without it; `draws`: two pairs of sessions, with and without the law,
    each with its own draw of the noise."""
    spatial = {axis for axis, *_ in law.axes} & SPATIAL
    table = TABLES[law.acts] if spatial or law.acts in {"variance", "widths"} else _levels
    (_, healthy), _ = draws
    first, second = (
        table(law, camera, present, healthy).value - table(law, camera, absent, healthy).value
        for present, absent in draws
    )
    return _beyond(first, second, table(law, camera, healthy, healthy))


def _beyond(first: FloatArray, second: FloatArray, healthy: AxisTable) -> float:
    """d1' (C + N N')^-1 d2, at least 0, of a change (blocks, n) that was measured twice."""
    lower = [cholesky(c, lower=True) for c in healthy.covariance]

    def white(blocks: FloatArray) -> FloatArray:
        return np.concatenate([solve_triangular(low, b, lower=True) for low, b in zip(lower, blocks, strict=True)])

    one, two, beside = white(first), white(second), white(healthy.nuisance)
    within = cho_factor(beside.T @ beside + np.eye(beside.shape[1]), lower=True)
    return max(float(one @ two - (one @ beside) @ cho_solve(within, beside.T @ two)), 0.0)


# --- groups of equal captures, and classes of pixels ------------------------------------------------------------------


@dataclass(frozen=True)
class _Group:
    """Captures of one setting: their numbers in the session, frames (k, rows, cols), and the first one's
    description."""

    numbers: tuple[int, ...]
    frames: FloatArray
    capture: dict[str, Any]

    @property
    def exposure_s(self) -> float:
        return float(self.capture["exposure_s"])


def _groups(session: DrawnSession, kinds: frozenset[str] | None = None) -> list[_Group]:
    """Return the settings of a session in their order, captures that follow one another; `kinds`: None: all."""

    def setting(numbered: tuple[int, dict[str, Any]]) -> tuple[str, ...]:
        return tuple(str(numbered[1].get(key)) for key in SETTING)

    captures = session.manifest["captures"]
    wanted = [(number, c) for number, c in enumerate(captures) if kinds is None or c["kind"] in kinds]
    runs = [list(run) for _, run in groupby(wanted, setting)]
    return [
        _Group(
            tuple(n for n, _ in run), np.stack([session.frames[c["frame"]] for _, c in run]).astype(float), run[0][1]
        )
        for run in runs
    ]


def _phase(camera: ConcealedCamera) -> NDArray[np.intp]:
    """Number of a pixel's place in its mosaic's cell; 0 throughout without a mosaic."""
    r, c = np.indices((camera.rows, camera.cols))
    return np.asarray(2 * (r % 2) + c % 2 if camera.cfa != "MONO" else np.zeros(r.shape, int))


SPATIAL = frozenset({"row", "column", "radius", "angle"})


def _place(law: UnlistedLaw, camera: ConcealedCamera) -> NDArray[np.intp]:
    """Number of each pixel's class along the law's spatial axes."""
    r, c = np.indices((camera.rows, camera.cols))
    x, y = camera.field_position
    kind = np.zeros(r.shape, int)
    for number, (axis, *_) in enumerate(law.axes):
        period = law.periods[number] if number < len(law.periods) else 0
        if axis in {"row", "column"}:
            index, count = (r, camera.rows) if axis == "row" else (c, camera.cols)
            kind = kind * (period or count) + (index % period if period else index)
        elif axis == "radius":
            kind = kind * RINGS + np.minimum(RINGS * (np.square(x) + np.square(y)), RINGS - 1).astype(int)
        elif axis == "angle":
            kind = kind * CELLS**2 + CELLS * (CELLS * r // camera.rows) + CELLS * c // camera.cols
    return kind


def _signal_dn(camera: ConcealedCamera, mean_dn: FloatArray) -> FloatArray:
    """Return the signal of a mean over many pixels: what noise leaves below black is none."""
    return np.maximum(mean_dn - camera.black_level_dn, 0.0)


def _noise_dn2(camera: ConcealedCamera, signal_dn: FloatArray) -> FloatArray:
    """Variance of a pixel from frame to frame: shot noise, read noise and rounding, DN^2."""
    return camera.gain_dn_per_e * signal_dn + (camera.gain_dn_per_e * camera.read_noise_e) ** 2 + 1.0 / 12.0


# --- means over classes of pixels -------------------------------------------------------------------------------------


def _means(law: UnlistedLaw, camera: ConcealedCamera, session: DrawnSession, healthy: DrawnSession) -> AxisTable:
    """Means of dark frames and flats over classes of pixels: a block for each class, a number in it for each setting.

    Beside the law may stand the level of each setting and place in the mosaic, and what light and lens do: x, y, r^2
    and r^4 in proportion to the signal; of columns besides an offset of their own."""
    places, phase = _place(law, camera), _phase(camera)
    labels, kind = np.unique(places * 4 + phase, return_inverse=True)
    kind, pixels = kind.ravel(), np.bincount(kind.ravel())

    def mean(frame: FloatArray) -> FloatArray:
        return np.bincount(kind, frame.ravel()) / pixels

    kinds = frozenset({"dark", "flat"})
    groups, same = _groups(session, kinds), _groups(healthy, kinds)
    value = np.stack([mean(g.frames.mean(0)) for g in groups], axis=1)
    signal = _signal_dn(camera, np.stack([mean(g.frames.mean(0)) for g in same], axis=1))
    light = np.array([g.capture["kind"] != "dark" for g in same])
    blocks, n = value.shape
    covariance = np.zeros((blocks, n, n))
    one = np.arange(n)
    repeats = np.array([len(g.numbers) for g in same])
    covariance[:, one, one] = _noise_dn2(camera, signal) / (pixels[:, None] * repeats)
    lit = camera.prnu_percent / 100.0 * signal * light
    fixed = camera.gain_dn_per_e * camera.dsnu_e
    covariance += (lit[:, :, None] * lit[:, None, :] + fixed**2) / pixels[:, None, None]
    if any(axis == "column" for axis, *_ in law.axes):
        covariance += (FREE * covariance[:, one, one].max(axis=1))[:, None, None]
    x, y = camera.field_position
    r2 = np.square(x) + np.square(y)
    # the whole frame tells what is smooth from what repeats over a few pixels
    share = 0.0 if law.periods else FIELD_SHARE
    smooth = share * np.stack([mean(f) for f in (x, y, r2, r2**2)], axis=1)
    colours = np.unique(labels % 4)
    of_colour = (labels % 4)[:, None] == colours
    level = LEVEL_DN * of_colour[:, None, :, None] * np.eye(n)[None, :, None, :]
    field = of_colour[:, None, :, None] * smooth[:, None, None, :] * (signal * light)[:, :, None, None]
    nuisance = np.concatenate([level.reshape(blocks, n, -1), field.reshape(blocks, n, -1)], axis=2)
    return AxisTable(value, covariance, nuisance)


# --- levels of whole frames -------------------------------------------------------------------------------------------


def _levels(law: UnlistedLaw, camera: ConcealedCamera, session: DrawnSession, healthy: DrawnSession) -> AxisTable:
    """Means of whole frames by colour, of dark frames, flats and narrowband light: one block.

    Beside the law may stand the black level and its drift, dark current at each temperature, the source's drift, an
    offset of the exposure, a response with the square and the cube of the level; of each colour its gain; of
    narrowband light the curve's scale, tilt and bend, an offset of the wavelength, a wider line, and an even leak."""
    kinds = frozenset({"dark", "flat", "narrowband"})
    phase, cfa = _phase(camera), camera.cfa
    colour_of = np.array(["Y"] if cfa == "MONO" else list(cfa))
    colours = sorted(set(colour_of))
    masks = [np.isin(phase, np.flatnonzero(colour_of == c)) for c in colours]
    groups, same = _groups(session, kinds), _groups(healthy, kinds)

    def table(of: list[_Group]) -> FloatArray:
        return np.array([[frame[m].mean() for m in masks] for g in of for frame in g.frames])

    value, signal = table(groups), _signal_dn(camera, table(same))
    rows = [(i, g, k) for i, g in enumerate(same) for k in g.numbers]
    n, count = signal.size, len(masks)
    group = np.repeat([i for i, _, _ in rows], count)
    begun = datetime.fromisoformat(healthy.manifest["captures"][0]["time"])
    taken = [datetime.fromisoformat(healthy.manifest["captures"][k]["time"]) for _, _, k in rows]
    time = np.repeat([(t - begun).total_seconds() / 60.0 for t in taken], count)
    exposure = np.repeat([g.exposure_s for _, g, _ in rows], count)
    kind = np.repeat([g.capture["kind"] for _, g, _ in rows], count)
    warm = np.repeat([g.capture["temperature_c"] for _, g, _ in rows], count)
    wavelength = np.repeat([float(g.capture.get("wavelength_nm", 0.0)) for _, g, _ in rows], count)
    colour, s = np.tile(np.arange(count), len(rows)), signal.ravel()
    pixels = np.tile([m.sum() for m in masks], len(rows))
    covariance = np.diag(_noise_dn2(camera, s) / pixels)
    same_level = (group[:, None] == group) & (colour[:, None] == colour)
    covariance += same_level * np.outer(s, s) * LEVEL_STD**2
    narrow = kind == "narrowband"
    reading = (group[:, None] == group) * np.outer(s * narrow, s * narrow) * READING_STD**2
    smooth = np.exp(-0.5 * np.square((wavelength[:, None] - wavelength) / CURVE_NM)) * (colour[:, None] == colour)
    covariance += reading + smooth * np.outer(s * narrow, s * narrow) * CURVE_STD**2
    full = camera.full_code_dn - camera.black_level_dn
    lit = s * (kind != "dark")
    columns = [BLACK_DN * np.ones(n), BLACK_DN_PER_MIN * time, DRIFT_PER_MIN * lit * time, OFFSET_S * lit / exposure]
    columns += [DARK_DN_PER_S * exposure * (warm == t) for t in np.unique(warm)]
    columns += [BEND_SHARE * lit**2 / full, BEND_SHARE * lit**3 / full**2]
    for k in range(count):
        columns += [GAIN_SHARE * s * (colour == k) * (kind == what) for what in ("flat", "narrowband")]
        columns += _spectral_columns(camera, colours[k], wavelength, s * (colour == k) * narrow)
    return AxisTable(value.reshape(1, n), covariance[None], np.stack(columns, axis=1)[None])


def _spectral_columns(
    camera: ConcealedCamera, colour: str, wavelength_nm: FloatArray, signal: FloatArray
) -> list[FloatArray]:
    """Return what else changes the signals (n,) of narrowband light."""
    away = (wavelength_nm - 560.0) / 100.0
    curve = camera.stated_efficiency[colour]
    at = np.interp(wavelength_nm, WAVELENGTH_NM, curve)
    slope = np.interp(wavelength_nm, WAVELENGTH_NM, np.gradient(curve)) / np.maximum(at, 1e-4)
    bend = np.interp(wavelength_nm, WAVELENGTH_NM, np.gradient(np.gradient(curve))) / np.maximum(at, 1e-4)
    return [
        TILT * signal * away,
        CURVE_BEND * signal * away**2,
        LINE_OFFSET_NM * signal * slope,
        LINE_WIDTH_NM2 * signal * bend,
        LEAK_DN * (signal > 0.0),
    ]


# --- variances and covariances ----------------------------------------------------------------------------------------


def _variances(law: UnlistedLaw, camera: ConcealedCamera, session: DrawnSession, healthy: DrawnSession) -> AxisTable:
    """Variances of pixels over repeats, by setting, level and class of pixels, and with an axis of place free by
    setting and level: one block a setting and level. Without such an axis a block has one number. Beside the law may
    stand read noise, gain, and what grows with the level's square."""
    places = _place(law, camera)
    spatial = bool({a[0] for a in law.axes} & SPATIAL)
    classes = int(places.max()) + 1
    values, variances, columns = [], [], []
    scale = (camera.full_code_dn - camera.black_level_dn) / LEVEL_BINS
    for g, same in zip(_groups(session), _groups(healthy), strict=True):
        if len(g.numbers) < 2:
            continue
        mean = same.frames.mean(0)
        bin_of = np.minimum(_signal_dn(camera, mean) / scale, LEVEL_BINS - 1).astype(int)
        spread = g.frames.var(axis=0, ddof=1)
        for one in np.unique(bin_of):
            inside = bin_of == one
            pixels = np.bincount(places[inside], minlength=classes)
            if pixels.min() < 100:
                continue
            signal = _signal_dn(camera, np.bincount(places[inside], mean[inside], classes) / pixels)
            noise = _noise_dn2(camera, signal)
            values.append(np.bincount(places[inside], spread[inside], classes) / pixels)
            variances.append(2.0 * noise**2 / (pixels * (len(g.numbers) - 1)))
            of_square = signal**2 / (LEVEL_BINS * scale)
            beside = READ_DN2 * np.ones(classes), GAIN_SHARE * signal, GAIN_SHARE * of_square
            columns.append(np.stack(beside, axis=1))
    covariance = np.stack([np.diag(v) for v in variances])
    if spatial:
        covariance += FREE * np.stack(variances).max(axis=1)[:, None, None]
    return AxisTable(np.stack(values), covariance, np.stack(columns))


def _covariances(law: UnlistedLaw, camera: ConcealedCamera, session: DrawnSession, healthy: DrawnSession) -> AxisTable:
    """Covariances over repeats of pixels and those below, by the row's residue: a block of a number for each residue,
    one block for each setting, in which the mean over residues is free."""
    period = law.periods[0]
    values, variances = [], []
    for g, same in zip(_groups(session), _groups(healthy), strict=True):
        if len(g.numbers) < 2:
            continue
        away = g.frames - g.frames.mean(axis=0)
        shared = (away[:, :-1] * away[:, 1:]).sum(axis=0) / (len(g.numbers) - 1)
        # not clipped at black: the products below are averaged
        noise = _noise_dn2(camera, same.frames.mean(0) - camera.black_level_dn)
        product = noise[:-1] * noise[1:] / (len(g.numbers) - 1)
        rows = np.arange(len(shared)) % period
        values.append([shared[rows == k].mean() for k in range(period)])
        variances.append([product[rows == k].mean() / product[rows == k].size for k in range(period)])
    spread = np.array(variances)
    covariance = np.stack([np.diag(v) for v in spread]) + FREE * spread.max(axis=1)[:, None, None]
    return AxisTable(np.array(values), covariance, np.zeros((*spread.shape, 0)))


# --- codes ------------------------------------------------------------------------------------------------------------


def _widths(law: UnlistedLaw, camera: ConcealedCamera, session: DrawnSession, healthy: DrawnSession) -> AxisTable:
    """Numbers of pixels by residue of their code, below and above three quarters of the range, in all frames with
    light: one block. Beside the law may stand the total below and above, and what repeats with the largest divisor of
    the period that a listed law of bits has (8 codes)."""
    period, count = law.periods[0], int(camera.full_code_dn) + 1
    codes = np.arange(count)
    above = codes >= 3 * count // 4
    kind = above * period + codes % period

    def histogram(of: DrawnSession) -> FloatArray:
        lit = [c["frame"] for c in of.manifest["captures"] if c["kind"] not in {"dark", "black"}]
        whole = sum(np.bincount(of.frames[f].ravel(), minlength=count) for f in lit)
        # what clips piles up in the last codes
        inner = np.where((codes > 0) & (codes < count - 1), whole, 0)
        return np.bincount(kind, inner, 2 * period).astype(float)

    value, expected = histogram(session), np.maximum(histogram(healthy), 1.0)
    residue, top = np.arange(2 * period) % period, np.arange(2 * period) >= period
    listed = gcd(period, 8)
    patterns = [top, ~top, *(residue % listed == k for k in range(listed))]
    nuisance = np.stack([GAIN_SHARE * expected * p for p in patterns], axis=1)
    return AxisTable(value[None], np.diag(expected)[None], nuisance[None])


TABLES: dict[str, Callable[[UnlistedLaw, ConcealedCamera, DrawnSession, DrawnSession], AxisTable]] = {
    "offset": _means, "factor": _means, "variance": _variances, "covariance": _covariances, "widths": _widths,
}  # fmt: skip


#: Of every block of cases: each law once, as many healthy cameras.
BLOCK = 2 * len(UNLISTED)
#: Of twenty laws, so many stand beside a listed effect; others in each block.
BESIDE = 4
#: Listed effects that stand beside a law; none of them acts along the axes of one.
COMPANIONS: tuple[type[Law], ...] = tuple(
    law
    for law in LISTED
    if law.name
    in {"optical_low_pass_filter", "defocus", "infrared_cut_filter", "veiling_glare", "hot_pixels", "vignetting"}
)
TARGETS, COMPANION_TARGETS = (10.0, 600.0), (100.0, 1000.0)  # ranges of separability, and of non-centrality
SIZING_ROUNDS, SIZING_FACTOR = 6, 1.3
COMPANION_ROUNDS = 2  # its summaries take long, and its strength is of no account
#: Captures of which means need no others: they come first in a session.
UNIFORM = ("dark", "flat", "narrowband")
MOSAICS = ("RGGB", "BGGR", "GRBG", "GBRG", "MONO")
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
AnyLaw = TypeVar("AnyLaw", bound=Law)
Take = Callable[[tuple[Law, ...], int], DrawnSession]


def concealed_in(seed: int, index: int) -> tuple[type[UnlistedLaw] | None, bool]:
    """Return the law of case number `index` (from 1 on), None of a healthy camera, and whether it stands beside a
    listed effect. Every block holds each law once, and in `len(UNLISTED) / BESIDE` blocks each stands beside one
    once."""
    block, place = divmod(index - 1, BLOCK)
    number = int(np.random.default_rng([seed, 3000, block]).permutation(BLOCK)[place])
    if number >= len(UNLISTED):
        return None, False
    turn = int(np.random.default_rng([seed, 3001]).permutation(len(UNLISTED))[number]) // BESIDE
    return UNLISTED[number], turn == block % (len(UNLISTED) // BESIDE)


def target_of(seed: int, index: int) -> float:
    """Return the separability that the law of a case is drawn for. Over the blocks a law's are spread evenly in the
    logarithm, by steps of the golden ratio."""
    law, _ = concealed_in(seed, index)
    first = np.random.default_rng([seed, 3002, 0 if law is None else UNLISTED.index(law)]).random()
    low, high = TARGETS
    return float(low * (high / low) ** ((first + GOLDEN * ((index - 1) // BLOCK)) % 1.0))


def draw_unlisted(
    seed: int, index: int, size: str = "medium", *, cfa: str | None = None, law: type[UnlistedLaw] | None = None
) -> Case:
    """Case number `index`; the same arguments give the same case. `cfa`, `law`: None: as drawn. Raises InputError for a
    size that has no one frame."""
    kind, beside = (law, False) if law is not None else concealed_in(seed, index)
    rng = np.random.default_rng([seed, index, 4])
    frame = SIZES[size]
    if frame is None:
        raise InputError(f"size {size!r}: laws of no list are sized for one frame; take small, medium or full")
    camera_seed, mosaic = int(rng.integers(1, 2**31)), str(rng.choice(MOSAICS))
    if kind is not None and kind.needs == "bayer" and mosaic == "MONO":
        mosaic = MOSAICS[int(rng.integers(4))]
    mosaic = cfa or mosaic
    lights, warm, shuttle, exposures = (bool(rng.random() < share) for share in (0.3, 0.4, 0.4, 0.3))
    drop = "chart" if rng.random() < 0.15 else "screen" if rng.random() < 0.15 else ""
    kinds = tuple(k for k in Plan.kinds if k != drop)
    plan = Plan(kinds=kinds, lights=lights, warm=warm, shuttle=shuttle, exposures=exposures)

    def camera(present: tuple[Law, ...] = (), noise_draw: int = 0) -> ConcealedCamera:
        return ConcealedCamera(camera_seed, present, cfa=mosaic, rows=frame[0], cols=frame[1], noise_draw=noise_draw)

    @lru_cache(maxsize=6)
    def take(present: tuple[Law, ...], noise_draw: int) -> DrawnSession:
        return record(camera(present, noise_draw), plan)

    @lru_cache(maxsize=6)
    def take_uniform(present: tuple[Law, ...], noise_draw: int) -> DrawnSession:
        return record(camera(present, noise_draw), replace(plan, kinds=UNIFORM))

    laws: list[Law] = []
    concealed: list[Concealed] = []
    if kind is not None:
        first = kind(kind.nominal, int(rng.integers(kind.variants)), int(rng.integers(2**31)))
        bare = camera()
        quick = take_uniform if kind.acts in {"offset", "factor"} else take

        def plain(one: UnlistedLaw) -> float:
            return separability_along(one, bare, [(quick((one,), k), quick((), k)) for k in (0, 1)])

        found, _ = sized(first, plain, target_of(seed, index))
        laws.append(found)
        if beside:
            other = COMPANIONS[int(rng.integers(len(COMPANIONS)))]
            companion = other(other.nominal, int(rng.integers(other.variants)), int(rng.integers(2**31)))
            wanted = float(np.exp(rng.uniform(*np.log(COMPANION_TARGETS))))
            laws.append(sized(companion, lambda one: _shown(take, (one,), ()), wanted, COMPANION_ROUNDS)[0])
        whole = tuple(laws)
        for one in laws:
            others = tuple(law for law in whole if law is not one)
            separability, shown = None, take
            if isinstance(one, UnlistedLaw):
                pairs = [(quick(whole, k), quick(others, k)) for k in (0, 1)]
                separability, shown = separability_along(one, bare, pairs), take_uniform
            concealed.append(
                Concealed(
                    name=one.name,
                    effect=one.listed_effect,
                    variant=one.variant,
                    strength=one.strength,
                    unit=one.unit,
                    parameters=one.library_parameters(),
                    noncentrality=_shown(shown, whole, others),
                    separability=separability,
                )
            )
    session = take(tuple(laws), 0)
    truth = CaseTruth(
        kind="healthy" if not laws else "outside" if len(laws) == 1 else "compound",
        concealed=tuple(concealed),
        accepts=tuple(sorted({name for one in laws for name in one.accepts})),
        cfa=mosaic,
        f_number=camera().f_number,
        frames=len(session.manifest["captures"]),
        rows=frame[0],
        cols=frame[1],
    )
    return Case(recording_set(session), truth)


def sized(
    law: AnyLaw, measured: Callable[[AnyLaw], float], target: float, rounds: int = SIZING_ROUNDS
) -> tuple[AnyLaw, float]:
    """Return the law at the strength at which it measures about the target, within its limits and after so many
    `rounds` at most, and what it measures there."""
    size = measured(law)
    low, high = law.limits
    for _ in range(rounds):
        if target / SIZING_FACTOR < size < SIZING_FACTOR * target:
            break
        # below 0.1 rounding is measured
        ratio = float(np.clip((target / max(size, 0.1)) ** (0.5 / law.power), 0.1, 10.0))
        strength = float(np.clip(law.strength * ratio, low, high))
        if strength == law.strength:
            break
        law = type(law)(strength, law.variant, law.seed)
        size = measured(law)
    return law, size


def _shown(take: Take, present: tuple[Law, ...], absent: tuple[Law, ...]) -> float:
    """Return the non-centrality of a change in the diagnosis's own summaries."""
    pairs = [tuple(summaries(recording_set(take(laws, k))) for laws in (present, absent)) for k in (0, 1)]
    return noncentrality([(one, other) for one, other in pairs])
