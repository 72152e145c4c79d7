"""The fine structure of even light: the two greens against each other, steps where read-outs meet, stripes of even and odd lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.diagnose.measurements.neighbours import held_out_flats
from lab.diagnose.measurements.summaries import BLACK_FLOOR_DN, Block, Effects, Label, Prediction, Study, act_on
from lab.errors import NotDetermined
from sim.frame import collected_mosaic
from sim.sensor import mosaic
from sim.spectrum import FloatArray

GREEN_FLOOR = 1e-4  # of a ratio: what two greens that are alike may differ by
GREEN_NOISE = 0.02  # of a ratio: what a frame's has to be known to
CELLS = (3, 4)
TILE_ROWS, TILE_COLS = 64, 4  # uniform light on which the effects act
LINE_FLOOR = 1e-4  # of a step in an even field's lines
#: Where read-outs meet, as shares of a side.
MEETING = (0.25, 0.5, 0.75)


@dataclass(frozen=True)
class Uniform:
    """Frames of even light at one setting: means above black by plane (DN), over its frames; `relative`: their sum by pixel over
    the planes' means, and how many DN of signal that holds."""

    captures: tuple[Any, ...]
    held_out: bool
    mean: dict[str, float]
    ratios: tuple[float, ...]  # of the two greens, frame by frame, less 1


def _unclipped(study: Study, capture: Any) -> bool:
    return all(m is not None for m in study.levels(capture).mean.values())


def flats(study: Study) -> tuple[list[Uniform], dict[bool, tuple[FloatArray, float]]]:
    """Unclipped flats by level; and for what is seen (False) and what is held out the sum of their frames above black, each
    plane over its mean, with weights by signal, and the variance of that by shot and read noise, a pixel."""
    out = study.once(held_out_flats)
    levels: list[Uniform] = []
    total: dict[bool, Any] = {}
    weights: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for group in study.flat_levels():
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            part = [c for c in part if _unclipped(study, c)]  # noqa: PLW2901
            if not part:
                continue
            held_out = part[0].id in out
            means, ratios = [], []
            for capture in part:
                frame = np.asarray(study.recordings.frame(capture), np.float32) - np.float32(_dark_dn(study, capture))
                own = {n: float(p.mean(dtype=float)) for n, p in mosaic.planes(frame, study.camera.cfa).items()}
                means.append(own)
                if "G1" in own:
                    ratios.append(_ratio(study, frame))
                weight = float(np.mean(list(own.values())))
                if weight < 10.0 * study.noise.read_dn:
                    continue
                for name, plane in mosaic.planes(frame, study.camera.cfa).items():
                    np.multiply(plane, np.float32(weight / own[name]), out=plane)
                total[held_out] = total[held_out] + frame if held_out in total else frame
                noise = sum((study.noise.gain * m + study.noise.read_dn**2) / m**2 for m in own.values()) / len(own)
                weights[held_out].append((weight, noise))
            mean = {n: float(np.mean([m[n] for m in means])) for n in means[0]}
            levels.append(Uniform(tuple(part), held_out, mean, tuple(ratios)))
    images = {}
    for held_out, image in total.items():
        w = np.array(weights[held_out])
        share = w[:, 0] / w[:, 0].sum()
        images[held_out] = image / np.float32(w[:, 0].sum()), float(np.sum(np.square(share) * w[:, 1]))
    return sorted(levels, key=lambda u: sum(u.mean.values())), images


def _dark_dn(study: Study, capture: Any) -> float:
    return study.noise.black + study.noise.dark_dn_per_s * float(capture.exposure_s)


def _green_dark(study: Study) -> float:
    """Mean of the greens on red rows less that of those on blue rows in the dark, DN: columns' offsets and the like."""
    captures = study.recordings.captures(DarkCapture, study.side)[:16]
    pairs = [_greens(study, np.asarray(study.recordings.frame(c), np.float32)) for c in captures]
    return float(np.mean([float(a.mean(dtype=float)) - float(b.mean(dtype=float)) for a, b in pairs])) if pairs else 0.0


def _greens(study: Study, frame: Any) -> tuple[Any, Any]:
    """The green pixels on red rows, but for the outermost, and for each the mean of the four on blue rows across its corners: a slope
    of the light falls on both alike."""
    row, col = mosaic.phases(study.camera.cfa)["G"][0]
    red_rows = frame[row + 2 * (row == 0) : -1 : 2, col + 2 * (col == 0) : -1 : 2]
    first = row + 2 * (row == 0) - 1, col + 2 * (col == 0) - 1
    blue_rows = frame[first[0] :: 2, first[1] :: 2]
    rows, cols = red_rows.shape
    corners = [blue_rows[i : i + rows, j : j + cols] for i in (0, 1) for j in (0, 1)]
    return red_rows, 0.25 * (corners[0] + corners[1] + corners[2] + corners[3])


def _ratio(study: Study, frame: Any) -> float:
    """Of a frame above black, less 1."""
    red_rows, blue_rows = _greens(study, frame)
    below = max(float(blue_rows.mean(dtype=float)), 1e-3)
    return (float(red_rows.mean(dtype=float)) - study.once(_green_dark)) / below - 1.0


# --- greens ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Ratio:
    """One ratio of the greens less 1, with what makes it uncertain by itself."""

    value: float
    std: float
    x: float
    condition: str
    captures: tuple[str, ...]
    held_out: bool
    mean: dict[str, float]  # by channel, DN
    exposure_s: float
    elapsed_s: float


def green_block(study: Study) -> Block:
    """Signal of the green pixels on red rows over that of those on blue rows, less 1: by level of flats, by wavelength, and by
    place relative to the frame's."""
    if study.camera.cfa == "MONO":
        raise NotDetermined("green_balance", "the camera has no colour mosaic")
    levels, images = study.once(flats)
    rows_dn2 = _rows_dn2(study, levels)
    every = *_by_level(study, levels, rows_dn2), *_by_wavelength(study, rows_dn2)
    ratios = [r for r in every if r.std < GREEN_NOISE]
    if not ratios:
        raise NotDetermined("green_balance", "no unclipped flat or narrowband captures")
    pixels = (study.camera.rows // 2) * (study.camera.cols // 2)
    common = 2.0 * study.noise.prnu**2 / pixels
    value = np.array([r.value for r in ratios])
    covariance = np.diag([r.std**2 + GREEN_FLOOR**2 for r in ratios]) + common
    labels = [Label(r.x, "G", r.condition, r.captures, r.held_out) for r in ratios]
    number = CELLS[0] * CELLS[1]
    for held_out, (image, noise) in sorted(images.items()):  # what is seen first
        red_rows, blue_rows = _greens(study, image)
        place = _cell_means(red_rows) / _cell_means(blue_rows)
        members = tuple(c.id for u in levels if u.held_out == held_out for c in u.captures)
        value = np.concatenate([value, (place / place.mean() - 1.0).ravel()])
        labels += [Label(0.0, "G", f"cell {k // CELLS[1]},{k % CELLS[1]}", members, held_out) for k in range(number)]
        size, one = len(covariance), 2.0 * number / pixels
        bigger = np.zeros((size + number, size + number))
        bigger[:size, :size] = covariance
        centred = np.eye(number) - 1.0 / number
        bigger[size:, size:] = one * (study.noise.prnu**2 + noise) * centred + GREEN_FLOOR**2 * np.eye(number)
        if held_out and False in images:
            # the pixels' own responses are the same in both
            bigger[size:, size - number : size] = one * study.noise.prnu**2 * centred
            bigger[size - number : size, size:] = one * study.noise.prnu**2 * centred
        covariance = bigger
    cells = len(value) - len(ratios)

    def predict(effects: Effects) -> Prediction:
        acting = any(act_on(effects, GREENS))
        found = [_predicted_ratio(r, effects, study) if acting else 0.0 for r in ratios]
        return Prediction(np.concatenate([found, np.zeros(cells)]), {})

    return Block(
        measurement="green_balance", axis="wavelength", unit="nm", reach=25.0, value=value, covariance=covariance, labels=tuple(labels),
        reads=GREENS, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def _rows_dn2(study: Study, levels: Sequence[Uniform]) -> float:
    """What the greens' difference in two frames of a level differs by beyond shot and read noise (DN^2): rows that are read with noise
    of their own."""
    excess, weights = 0.0, 0.0
    for u in levels:
        signal = u.mean["G2"]
        if len(u.ratios) > 1 and signal > 0:
            shot = _shot_dn2(study, signal)
            weight = (len(u.ratios) - 1) / shot**2
            excess += weight * (float(np.var(u.ratios, ddof=1)) * signal**2 - shot)
            weights += weight
    # what chance makes of none isn't taken for some
    return max(excess / weights - weights**-0.5, 0.0) if weights > 0 else 0.0


def _shot_dn2(study: Study, signal: float) -> float:
    """Variance of the difference of the greens' means in one frame by shot and read noise, DN^2."""
    pixels = (study.camera.rows // 2) * (study.camera.cols // 2)
    return 2.0 * (study.noise.gain * signal + study.noise.read_dn**2) / pixels


def _by_level(study: Study, levels: Sequence[Uniform], rows_dn2: float) -> list[_Ratio]:
    found = []
    for u in levels:
        signal = u.mean["G2"]
        if signal <= 0:
            continue
        dn2 = (_shot_dn2(study, signal) + rows_dn2) / len(u.ratios) + 2.0 * BLACK_FLOOR_DN**2
        std = float(np.sqrt(dn2)) / signal
        c = u.captures[0]
        mean = {"R": u.mean["R"], "G": 0.5 * (u.mean["G1"] + signal), "B": u.mean["B"]}
        found.append(
            _Ratio(float(np.mean(u.ratios)), std, 0.0, f"{signal:.4g} DN", tuple(c.id for c in u.captures), u.held_out, mean, c.exposure_s, study.elapsed_s(c))
        )  # fmt: skip
    return found


def _by_wavelength(study: Study, rows_dn2: float) -> list[_Ratio]:
    found = []
    groups = study.groups(NarrowbandCapture, lambda c: (c.wavelength_nm, c.exposure_s, c.radiance))
    for i, group in enumerate(groups):
        for capture in group:
            if study.levels(capture).mean["G"] is None:
                continue
            frame = np.asarray(study.recordings.frame(capture), np.float32) - np.float32(_dark_dn(study, capture))
            own = {n: float(p.mean(dtype=float)) for n, p in mosaic.planes(frame, study.camera.cfa).items()}
            signal = own["G2"]
            if signal < 5.0:
                continue
            dn2 = _shot_dn2(study, signal) + rows_dn2 + 2.0 * BLACK_FLOOR_DN**2
            found.append(
                _Ratio(
                    _ratio(study, frame), float(np.sqrt(dn2)) / signal, capture.wavelength_nm,
                    f"{capture.wavelength_nm:g} nm", (capture.id,), i % 3 == 1, {"R": own["R"], "G": 0.5 * (own["G1"] + signal), "B": own["B"]},
                    capture.exposure_s, study.elapsed_s(capture),
                )
            )  # fmt: skip
    return found


#: Quantities of the stages that even light's fine structure depends on.
GREENS = frozenset({"light.rows", "charge.collected", "charge.kernels"})


def _predicted_ratio(ratio: _Ratio, effects: Effects, study: Study) -> float:
    shape = TILE_ROWS, TILE_COLS
    electrons = {c: np.full(shape, max(m, 0.0) / study.noise.gain) for c, m in ratio.mean.items()}
    tile = mosaic.assemble(electrons, study.camera.cfa)
    tile = collected_mosaic(study.camera, tile, effects, exposure_s=ratio.exposure_s, elapsed_s=ratio.elapsed_s)
    planes = mosaic.planes(tile, study.camera.cfa)
    return float(planes["G1"].mean() / max(float(planes["G2"].mean()), 1e-9)) - 1.0


def _cell_means(plane: FloatArray) -> FloatArray:
    rows, cols = (np.linspace(0, n, k + 1).astype(int) for n, k in zip(plane.shape, CELLS, strict=True))
    sums = np.add.reduceat(np.add.reduceat(np.asarray(plane, float), rows[:-1], 0), cols[:-1], 1)
    return np.asarray(sums / np.outer(np.diff(rows), np.diff(cols)))


# --- lines -----------------------------------------------------------------------------------------------------------------


def line_block(study: Study) -> Block:
    """Mean flats, each plane over its mean: steps in the lines' means at halves and quarters of a side, and what even and odd lines
    of a plane differ by. How uncertain a step is, steps everywhere else say."""
    _, images = study.once(flats)
    if not images:
        raise NotDetermined("flat_lines", "no unclipped flat captures")
    period = mosaic.step(study.camera.cfa)
    levels = study.once(flats)[0]
    values: list[float] = []
    labels: list[Label] = []
    whole: list[tuple[float, float]] = []
    for held_out, (image, noise) in sorted(images.items()):
        members = tuple(c.id for u in levels if u.held_out == held_out for c in u.captures)
        for axis, name in ((0, "column"), (1, "row")):
            line = np.asarray(image.mean(axis=axis, dtype=float))
            shot = noise / image.shape[axis]
            for share, value, std, size in _steps(line, period, study.noise.prnu / np.sqrt(image.shape[axis])):
                values.append(value)
                whole.append((std**2 + LINE_FLOOR**2, shot * size))
                labels.append(Label(share * len(line), name, f"{name} {share * len(line):.0f}", members, held_out))
            value, std = _stripes(line, period, study.noise.prnu / np.sqrt(image.shape[axis]))
            values.append(value)
            whole.append((std**2 + LINE_FLOOR**2, shot * 4.0 / len(line)))
            labels.append(Label(0.0, name, f"even and odd {name}s", members, held_out))
    covariance = np.diag([total for total, _ in whole])
    conditions = [label.condition for label in labels]
    for i, label in enumerate(labels):
        for j in range(i):
            if conditions[j] == label.condition:  # the same pixels, seen and held out: only the noise is another
                covariance[i, j] = covariance[j, i] = min(max(whole[k][0] - whole[k][1], 0.0) for k in (i, j))
    return Block(
        measurement="flat_lines", axis="field", unit="px", reach=1.0, value=np.array(values), covariance=covariance, labels=tuple(labels),
        reads=frozenset(), predict=lambda effects: Prediction(np.zeros(len(values)), {}), scale=np.ones(len(values)),
    )  # fmt: skip


def _steps(line: FloatArray, period: int, least: float) -> list[tuple[float, float, float, float]]:
    """(share of the side, step, its standard uncertainty, variance a line of variance 1 would give it) where read-outs meet: of a
    straight line with a step in `width` lines on either side, fitted."""
    width = max(len(line) // 16 // (2 * period) * 2 * period, 4 * period)
    x = np.arange(-width, width) + 0.5
    design = np.stack([np.ones_like(x), x, x > 0], axis=1)
    weight = np.linalg.pinv(design)[2]
    every = np.convolve(line, weight[::-1], mode="valid")  # at boundaries width, width + 1, ...
    size = float(np.sum(weight * weight))
    at = {share: round(share * len(line) / period) * period for share in MEETING}
    far = np.ones(len(every), bool)
    for b in at.values():
        far[max(b - 2 * width, 0) : max(b, 0) + 1] = False
    others = every[::period][far[::period]]
    spread = 1.4826 * float(np.median(np.abs(others - np.median(others)))) if len(others) >= 8 else 0.0
    std = max(spread, least * np.sqrt(size))
    return [(share, float(every[b - width]), std, size) for share, b in at.items() if 0 <= b - width < len(every)]


def _stripes(line: FloatArray, period: int, least: float) -> tuple[float, float]:
    """Mean of the even lines of a plane less that of the odd ones, and its standard uncertainty by how lines four periods apart
    depart from a straight line."""
    lag = 4 * period
    pairs = line[: len(line) // (2 * period) * 2 * period].reshape(-1, 2, period)
    value = float((pairs[:, 0] - pairs[:, 1]).mean())
    # the light's slope from a line to the next of the plane
    slope = float(np.mean(line[-lag:] - line[:lag])) / (len(line) - lag) * period
    bend = line[2 * lag :] - 2.0 * line[lag:-lag] + line[: -2 * lag]
    one = max(1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0), least)
    return value + slope, one * 2.0 / np.sqrt(len(line))
