"""Mean flat frames, and the ratio of the two green planes of the mosaic in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.capture_kinds.dark import DarkCapture
from lab.measure.study import Study, held_out_flats
from sim.sensor import mosaic
from sim.spectrum import FloatArray

LEAST_SIGNAL = 10.0  # of a frame that is a part of the mean image, in standard deviations of the read noise


@dataclass(frozen=True)
class FlatLevel:
    """The flat frames of one setting."""

    captures: tuple[Any, ...]
    held_out: bool
    mean: dict[str, float]  # above the dark level, by plane of the mosaic, DN
    ratios: tuple[float, ...]  # of each frame: signal of green on red rows over green on blue rows, less 1


def _unclipped(study: Study, capture: Any) -> bool:
    """Return whether no channel of the capture clips."""
    return all(m is not None for m in study.levels(capture).mean.values())


def flats(study: Study) -> tuple[list[FlatLevel], dict[bool, tuple[FloatArray, float]]]:
    """Unclipped flats by level, darkest first; and for seen (False) and held-out (True) ones a mean image with its
    pixels' variance.

    The image (rows, cols) is the mean over frames above the dark level, each plane of the mosaic over its mean,
    weighted by signal. The variance is that of a pixel of the image by shot and read noise.
    """
    out = study.once(held_out_flats)
    levels: list[FlatLevel] = []
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
                frame = np.asarray(study.recordings.frame(capture), np.float32) - np.float32(
                    dark_level_dn(study, capture)
                )
                own = {n: float(p.mean(dtype=float)) for n, p in mosaic.planes(frame, study.camera.cfa).items()}
                means.append(own)
                if "G1" in own:
                    ratios.append(green_ratio(study, frame))
                weight = float(np.mean(list(own.values())))
                if weight < LEAST_SIGNAL * study.noise.read_dn:
                    continue
                for name, plane in mosaic.planes(frame, study.camera.cfa).items():
                    np.multiply(plane, np.float32(weight / own[name]), out=plane)
                total[held_out] = total[held_out] + frame if held_out in total else frame
                noise = sum((study.noise.gain * m + study.noise.read_dn**2) / m**2 for m in own.values()) / len(own)
                weights[held_out].append((weight, noise))
            mean = {n: float(np.mean([m[n] for m in means])) for n in means[0]}
            levels.append(FlatLevel(tuple(part), held_out, mean, tuple(ratios)))
    images = {}
    for held_out, image in total.items():
        w = np.array(weights[held_out])
        share = w[:, 0] / w[:, 0].sum()
        images[held_out] = image / np.float32(w[:, 0].sum()), float(np.sum(np.square(share) * w[:, 1]))
    return sorted(levels, key=lambda u: sum(u.mean.values())), images


def dark_level_dn(study: Study, capture: Any) -> float:
    """Mean of a capture without light: black level + dark current x exposure, DN."""
    return study.noise.black + study.noise.dark_dn_per_s * float(capture.exposure_s)


def _green_dark(study: Study) -> float:
    """Difference of the two greens in dark frames, DN, by fixed patterns of the read-out; 0 without dark captures."""
    captures = study.recordings.captures(DarkCapture, study.side)[:16]
    pairs = [green_planes(study, np.asarray(study.recordings.frame(c), np.float32)) for c in captures]
    return float(np.mean([float(a.mean(dtype=float)) - float(b.mean(dtype=float)) for a, b in pairs])) if pairs else 0.0


def green_planes(study: Study, frame: Any) -> tuple[Any, Any]:
    """Return the green pixels on red rows, without those at the border, and for each the mean of its four diagonal
    neighbours, the greens on blue rows. A gradient of the light cancels in their ratio."""
    row, col = mosaic.phases(study.camera.cfa)["G"][0]
    red_rows = frame[row + 2 * (row == 0) : -1 : 2, col + 2 * (col == 0) : -1 : 2]
    first = row + 2 * (row == 0) - 1, col + 2 * (col == 0) - 1
    blue_rows = frame[first[0] :: 2, first[1] :: 2]
    rows, cols = red_rows.shape
    corners = [blue_rows[i : i + rows, j : j + cols] for i in (0, 1) for j in (0, 1)]
    return red_rows, 0.25 * (corners[0] + corners[1] + corners[2] + corners[3])


def green_ratio(study: Study, frame: Any) -> float:
    """Ratio of the two greens' means in a frame above the dark level, less 1, corrected for their difference in dark
    frames."""
    red_rows, blue_rows = green_planes(study, frame)
    below = max(float(blue_rows.mean(dtype=float)), 1e-3)
    return (float(red_rows.mean(dtype=float)) - study.once(_green_dark)) / below - 1.0
