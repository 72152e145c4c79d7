"""Mean levels of the patches of ColorChecker24 captures, and their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.chart import ChartCapture
from lab.formats.recording_set import CodeCounts, FrameCodes, RecordingSet
from lab.observables.dataset import CLIPPED_SHARE, Dataset, held_out_of, mean_frame
from lab.observables.surroundings import Surroundings, harmonics
from sim.point import optical_transfer
from sim.scene.colorchecker import reflectances
from sim.sensor import mosaic
from sim.spectrum import FloatArray

StrArray = NDArray[np.str_]
LEAST_PIXELS = 16  # of a channel, of a patch that is used
PATCH_STD = 0.01  # relative standard deviation of a patch's reflectance, common to the channels
PATCH_COLOUR_STD = 0.004  # the same, independent in each channel
PATCH_LEVEL_STD = (
    4.0e-4  # standard deviation of a patch's reflectance (perfect diffuser: 1): gloss, errors of dark patches
)


@dataclass(frozen=True)
class Patch:
    """One patch in one channel, averaged over the repeats of a capture; levels in DN."""

    captures: tuple[ChartCapture, ...]
    name: str
    channel: str
    level: float  # mean of the patch's inner part
    pixels: int
    row: float
    col: float
    frame: float  # mean of the whole frame in this channel
    around: Surroundings  # of the patch in one plane of the mosaic, above the dark level
    tail: float  # change of the patch's mean by the point spread function of the baseline
    held_out: bool


def patch_codes(recordings: RecordingSet, capture: ChartCapture) -> tuple[FrameCodes, ...]:
    """Return the codes of the inner part of each patch of one frame, in the chart's order, by cell of the frame's 2 x 2
    mosaic. They are counted once, whatever the manifest states of camera and light."""

    def counted() -> tuple[FrameCodes, ...]:
        frame = recordings.frame(capture)
        return tuple(
            FrameCodes.count(frame[slice(*rows), slice(*cols)]).moved(rows[0], cols[0])
            for _, rows, cols, *_ in patch_boxes(capture)
        )

    key = "patches", capture.frame, capture.chart, capture.corners
    return recordings.once(key, counted, whatever_is_stated=True)


def patch_levels(dataset: Dataset) -> list[Patch]:
    """Return the unclipped patches of all ColorChecker24 captures, by channel, seen and held-out repeats apart."""
    groups = dataset.groups(ChartCapture, lambda c: (c.chart, c.exposure_s, c.radiance, c.corners))
    groups = [g for g in groups if g[0].chart == "ColorChecker24"]
    recordings, cfa = dataset.recordings, dataset.camera.cfa
    step = mosaic.step(cfa)
    points = []
    for i, group in enumerate(groups):
        out = held_out_of(group, i, len(groups))
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if not part:
                continue
            patches = [patch_codes(recordings, capture) for capture in part]
            frame = mean_frame(recordings, part)
            for channel in dataset.channels:
                first_row, first_col = mosaic.phases(cfa)[channel][0]
                plane = frame[first_row::step, first_col::step]
                spread = _spread(dataset, plane, channel, part[0].radiance)
                mean = CodeCounts.total(cell for c in part for cell in recordings.codes(c).channels(cfa)[channel])
                low = harmonics(plane - dataset.noise.black - dataset.noise.dark_dn_per_s * part[0].exposure_s)
                for k, (name, rows, cols, row, col) in enumerate(patch_boxes(part[0])):
                    cells = [one[k].channels(cfa).get(channel, ()) for one in patches]
                    counts, first = CodeCounts.total(cell for own in cells for cell in own), CodeCounts.total(cells[0])
                    if first.pixels < LEAST_PIXELS or first.share_from(dataset.saturation_dn) >= CLIPPED_SHARE:
                        continue
                    inside = slice(rows[0] // step, rows[1] // step), slice(cols[0] // step, cols[1] // step)
                    points.append(
                        Patch(tuple(part), name, channel, counts.mean_dn, first.pixels, row, col, mean.mean_dn,
                              Surroundings.of_box(low, plane.shape, *inside), float(spread[inside].mean()),
                              part[0].id in out)
                    )  # fmt: skip
    return points


def patch_covariance(dataset: Dataset, points: list[Patch], signal: FloatArray) -> FloatArray:
    """Covariance (n, n), DN^2, of the levels of n patches.

    It is the sum of shot and read noise and PRNU, tolerances of the reflectance (one common to repeats and channels,
    one for each channel), of the point spread function's tail, rounding, and the lamp's repeatability, common to all
    patches of a capture."""
    noise = dataset.noise
    pixels = np.array([p.pixels for p in points])
    repeats = np.array([len(p.captures) for p in points])
    tail = np.array([p.tail for p in points])
    names = np.array([p.name for p in points])
    channel = np.array([p.channel for p in points])
    temporal = (noise.gain * signal + noise.read_dn**2) / pixels / repeats
    digits = noise.rounding_std_dn(signal)
    fixed = np.sqrt((noise.prnu * signal) ** 2 / pixels + digits**2)
    same = names[:, None] == names
    covariance = np.diag(temporal + noise.jitter_dn**2) + same * (channel[:, None] == channel) * np.outer(fixed, fixed)
    covariance += same * np.outer(tail, tail) * dataset.tail_std**2
    covariance += reflectance_covariance(names, channel, signal)
    taken = np.array([p.captures[0].id for p in points])
    lamp = signal * noise.jitter_lamp / np.sqrt(repeats)
    covariance += (taken[:, None] == taken) * np.outer(lamp, lamp)
    return np.asarray(covariance)


def reflectance_covariance(names: StrArray, channel: StrArray, signal: FloatArray) -> FloatArray:
    """Covariance (n, n), DN^2, of n patches' levels by the tolerances of their reflectances: one common to repeats and
    channels, one for each channel. `names`, `channel`: (n,) of the patches; `signal`: their levels above dark, DN."""
    same = names[:, None] == names
    perfect = np.array([signal[channel == c].max() / 0.9 for c in channel])  # DN of a perfect diffuser
    common = np.outer(signal, signal) * PATCH_STD**2 + np.outer(perfect, perfect) * PATCH_LEVEL_STD**2
    own = (channel[:, None] == channel) * np.outer(signal, signal) * PATCH_COLOUR_STD**2
    return np.asarray(same * (common + own))


def _spread(dataset: Dataset, plane: FloatArray, channel: str, light: str) -> FloatArray:
    """Change (DN) of a plane of the mosaic by the baseline's point spread function: plane convolved with it, less the
    plane.

    The recording stands for the scene, as well inside a patch blur changes it by a fraction of a per cent.
    """
    step = mosaic.step(dataset.camera.cfa)
    picture = np.pad(plane, [(0, n) for n in plane.shape], mode="symmetric")
    fy = np.fft.fftfreq(picture.shape[0], step)[:, None]
    fx = np.fft.rfftfreq(picture.shape[1], step)[None, :]
    otf = np.real(optical_transfer(dataset.camera, channel, dataset.spectrum(light), fx, fy))
    blurred = np.fft.irfft2(np.fft.rfft2(picture) * otf, picture.shape)
    return np.asarray(blurred[: plane.shape[0], : plane.shape[1]] - plane)


def patch_boxes(capture: ChartCapture) -> list[tuple[str, tuple[int, int], tuple[int, int], float, float]]:
    """(name, rows, columns, centre row, centre column) of the inner part of each patch: a square of 0.44 of the patch's
    side."""
    corners = np.array(capture.corners, float)
    found = []
    names = list(reflectances(capture.chart))
    for k, name in enumerate(names):
        i, j = divmod(k, 6)
        u, v = (j + 0.5) / 6.0, (i + 0.5) / 4.0
        centre = (1 - v) * ((1 - u) * corners[0] + u * corners[1]) + v * ((1 - u) * corners[3] + u * corners[2])
        right, down = (corners[1] - corners[0]) / 6.0, (corners[3] - corners[0]) / 4.0
        half = 0.22 * min(np.linalg.norm(right), np.linalg.norm(down))
        rows = (int(np.ceil(centre[0] - half)), int(np.floor(centre[0] + half)) + 1)
        cols = (int(np.ceil(centre[1] - half)), int(np.floor(centre[1] + half)) + 1)
        found.append((name, rows, cols, float(centre[0]), float(centre[1])))
    return found
