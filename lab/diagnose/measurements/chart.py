"""Mean levels of the patches of a ColorChecker chart, against its published reflectances and the maker's sensitivity
curves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.chart import ChartCapture
from lab.diagnose.measurements.block import LEVEL_REACH, Block, Effects, Label, Measurement, Prediction
from lab.diagnose.measurements.curves import CurveJacobian
from lab.diagnose.measurements.dark_level import added_dark_dn
from lab.diagnose.measurements.halo_light import Surroundings, halo_light, harmonics
from lab.diagnose.measurements.held_out import held_out_of
from lab.diagnose.measurements.reads import DARK_CURRENT
from lab.diagnose.measurements.row_light import ROW_LIGHT, nuisances, row_light_scatter
from lab.diagnose.measurements.saturation import CLIPPED_SHARE
from lab.diagnose.measurements.study import Study, mean_frame
from lab.errors import NotDetermined
from lab.measure.rounding import rounding_std_dn
from sim.point import even_share, optical_transfer, wide_contrast
from sim.scene.colorchecker import reflectances
from sim.sensor import mosaic
from sim.spectrum import FloatArray
from sim.uniform import LEVEL, SPECTRAL, FieldPoints, Uniform

StrArray = NDArray[np.str_]

PATCH_STD = 0.01  # relative standard deviation of a patch's reflectance, common to the channels
PATCH_COLOUR_STD = 0.004  # the same, independent in each channel
PATCH_LEVEL_STD = (
    4.0e-4  # standard deviation of a patch's reflectance (perfect diffuser: 1): gloss, errors of dark patches
)
#: Prior standard deviation of the light's level on the chart, and of its gradient from the middle to a side of the
#: frame, relative.
CHART_SCALE_STD, CHART_GRADIENT_STD = 0.05, 0.005


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


def chart_block(study: Study) -> Block:
    """Mean level (DN) of every patch of a ColorChecker24 by channel.

    Nuisance parameters: level and gradient of the light, the maker's sensitivity curves, black level and dark current.
    Tolerances of the reflectances are in the covariance. Raises NotDetermined where the sensitivity curves aren't
    stated, and with fewer than twelve unclipped patches.
    """
    if not study.stated.quantum_efficiency:
        raise NotDetermined(
            "chart", "the maker's sensitivity curves aren't stated: nothing to hold the recordings against"
        )
    points = patch_levels(study)
    if len(points) < 12:
        raise NotDetermined("chart", "fewer than twelve unclipped patches of a ColorChecker24")
    noise, camera = study.noise, study.camera
    value = np.array([p.level for p in points])
    exposures = np.array([p.captures[0].exposure_s for p in points])
    row, col = np.array([p.row for p in points]), np.array([p.col for p in points])
    tail = np.array([p.tail for p in points])
    offset = noise.black + noise.dark_dn_per_s * exposures
    signal = np.maximum(value - offset, 0.1)
    surround = np.array([p.frame for p in points]) - offset  # the mean light, of which a veil adds a share
    place = FieldPoints.at(camera, row, col)
    known = reflectances(points[0].captures[0].chart)
    curves = CurveJacobian(
        study,
        [(p.captures[0].radiance, p.channel, p.captures[0].exposure_s, "chart", known[p.name]) for p in points],
        signal / noise.gain / exposures,
    )
    names = {n: i for i, n in enumerate(known)}

    of_channel = {name: np.array([p.channel == name for p in points]) for name in study.channels}

    def predict(effects: Effects) -> Prediction:
        rates = curves.rates(effects)
        model = Uniform(camera, effects)
        time = np.array([model.collected_s(float(t)) for t in exposures])
        ambient = np.array([model.ambient_e(p.channel, float(t)) for p, t in zip(points, exposures, strict=True)])
        electrons = rates * model.field(place).light * (time + model.leaked_s(place))
        electrons = electrons * _mixing(study, points, electrons, model)
        veil = even_share(camera, effects) * surround + halo_light([p.around for p in points], effects, camera)
        electrons = wide_contrast(camera, effects) * electrons + (veil + tail) / noise.gain + ambient
        more = added_dark_dn(study, effects)
        dark = noise.dark_dn_per_s * exposures + np.array([more(p.captures[0]) for p in points])
        read_dn = np.empty(len(points))
        for name, mine in of_channel.items():
            read_dn[mine] = model.mean_dn({name: (electrons + dark / noise.gain)[mine, None]})[name]
        lit = read_dn - dark
        offset = study.offset(effects)
        shift = np.array([offset(p.captures[0]) for p in points])
        jacobian = study.free_offsets(exposures) | study.free_warmth([p.captures[0] for p in points])
        jacobian |= {k: v * lit / np.maximum(rates, 1e-30) for k, v in curves.jacobian(effects).items()}
        jacobian["chart:scale"] = CHART_SCALE_STD * lit
        jacobian["chart:x"] = CHART_GRADIENT_STD * lit * (col / camera.cols - 0.5) * 2
        jacobian["chart:y"] = CHART_GRADIENT_STD * lit * (row / camera.rows - 0.5) * 2
        jacobian |= _row_light(points, model, camera.rows, lit)
        return Prediction(noise.black + read_dn + shift, jacobian)

    return Block(
        measurement=CHART,
        reach=LEVEL_REACH,
        along=np.log(np.maximum(signal, 1.0)),
        value=value,
        covariance=patch_covariance(study, points, signal),
        labels=tuple(
            Label(float(names[p.name]), p.channel, p.name, tuple(c.id for c in p.captures), p.held_out) for p in points
        ),
        reads=(LEVEL - {"light.level"}) | SPECTRAL | DARK_CURRENT | {"image.veils"},
        scattered_by=ROW_LIGHT,
        predict=predict,
        scale=signal,
    )


def patch_levels(study: Study) -> list[Patch]:
    """The unclipped patches of all ColorChecker24 captures, by channel, seen and held-out repeats apart."""
    groups = study.groups(ChartCapture, lambda c: (c.chart, c.exposure_s, c.radiance, c.corners))
    groups = [g for g in groups if g[0].chart == "ColorChecker24"]
    step = mosaic.step(study.camera.cfa)
    points = []
    for i, group in enumerate(groups):
        out = held_out_of(group, i, len(groups))
        for part in ([c for c in group if c.id not in out], [c for c in group if c.id in out]):
            if not part:
                continue
            frame = mean_frame(study.recordings, part)
            clipped = study.recordings.frame(part[0]) >= study.saturation_dn
            for channel in study.channels:
                first_row, first_col = mosaic.phases(study.camera.cfa)[channel][0]
                plane = frame[first_row::step, first_col::step]
                spread = _spread(study, plane, channel, part[0].radiance)
                mean = float(study.pixels_of(frame, channel).mean())
                low = harmonics(plane - study.noise.black - study.noise.dark_dn_per_s * part[0].exposure_s)
                mask = study.plane_mask(channel, (study.camera.rows, study.camera.cols))
                for name, rows, cols, row, col in patch_boxes(part[0]):
                    box = (slice(*rows), slice(*cols))
                    values = frame[box][mask[box]]
                    if values.size < 16 or np.mean(clipped[box][mask[box]]) >= CLIPPED_SHARE:
                        continue
                    inside = slice(rows[0] // step, rows[1] // step), slice(cols[0] // step, cols[1] // step)
                    points.append(
                        Patch(tuple(part), name, channel, float(values.mean()), values.size, row, col, mean,
                        Surroundings.of_box(low, plane.shape, *inside),
                              float(spread[inside].mean()), part[0].id in out)
                    )  # fmt: skip
    return points


def patch_covariance(study: Study, points: list[Patch], signal: FloatArray) -> FloatArray:
    """Covariance (n, n), DN^2, of the levels of n patches.

    It is the sum of shot and read noise and PRNU, tolerances of the reflectance (one common to repeats and channels,
    one for each channel), of the point spread function's tail, rounding, and the lamp's repeatability, common to all
    patches of a capture."""
    noise = study.noise
    pixels = np.array([p.pixels for p in points])
    repeats = np.array([len(p.captures) for p in points])
    tail = np.array([p.tail for p in points])
    names = np.array([p.name for p in points])
    channel = np.array([p.channel for p in points])
    temporal = (noise.gain * signal + noise.read_dn**2) / pixels / repeats
    digits = rounding_std_dn(noise.spread_dn2(signal))
    fixed = np.sqrt((noise.prnu * signal) ** 2 / pixels + digits**2)
    same = names[:, None] == names
    covariance = np.diag(temporal + noise.jitter_dn**2) + same * (channel[:, None] == channel) * np.outer(fixed, fixed)
    covariance += same * np.outer(tail, tail) * study.tail_std**2
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


def _spread(study: Study, plane: FloatArray, channel: str, light: str) -> FloatArray:
    """Change (DN) of a plane of the mosaic by the baseline's point spread function: plane convolved with it, less the
    plane.

    The recording stands for the scene, as well inside a patch blur changes it by a fraction of a per cent.
    """
    step = mosaic.step(study.camera.cfa)
    picture = np.pad(plane, [(0, n) for n in plane.shape], mode="symmetric")
    fy = np.fft.fftfreq(picture.shape[0], step)[:, None]
    fx = np.fft.rfftfreq(picture.shape[1], step)[None, :]
    otf = np.real(optical_transfer(study.camera, channel, study.spectrum(light), fx, fy))
    blurred = np.fft.irfft2(np.fft.rfft2(picture) * otf, picture.shape)
    return np.asarray(blurred[: plane.shape[0], : plane.shape[1]] - plane)


def _row_light(points: list[Patch], model: Uniform, rows: int, lit: FloatArray) -> dict[str, FloatArray]:
    """Jacobian of the patches' levels by a light that varies while a frame is taken, of each capture's frames at
    once."""
    by_capture: dict[tuple[ChartCapture, ...], list[int]] = {}
    for i, p in enumerate(points):
        by_capture.setdefault(p.captures, []).append(i)
    vectors = []
    for captures, members in by_capture.items():
        at = np.clip(np.round([points[i].row for i in members]).astype(int), 0, rows - 1)
        exposure_s = captures[0].exposure_s
        for one in row_light_scatter(model, rows, exposure_s, len(captures), partial(np.take, indices=at, axis=1)):
            whole = np.zeros(len(points))
            whole[members] = one * lit[members]
            vectors.append(whole)
    return nuisances("chart", vectors)


def _mixing(study: Study, points: list[Patch], electrons: FloatArray, model: Uniform) -> FloatArray:
    """Factors (n,) on the patches' electrons by effects that move charge between neighbouring pixels of different
    channels."""
    factor = np.ones(len(points))
    by_patch: dict[tuple[str, str], dict[str, int]] = {}
    for i, p in enumerate(points):
        by_patch.setdefault((p.captures[0].id, p.name), {})[p.channel] = i
    for members in by_patch.values():
        if len(members) == len(study.channels):
            mixed = model.mixing_factors({c: float(electrons[i]) for c, i in members.items()})
            for c, i in members.items():
                factor[i] = mixed.get(c, 1.0)
    return factor


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


CHART = Measurement(
    "chart",
    title="patches of the chart",
    order=300,
    axis="level",
    unit="DN",
    make=chart_block,
    quantity="mean level, DN",
    is_level=True,
    places="patches",
)
