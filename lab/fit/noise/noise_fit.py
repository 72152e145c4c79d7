"""The noise fit of one camera: its darks and flats grouped into levels, all figures, by channel too, and the points of
its plots."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import special

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import InputError, NotDetermined
from lab.fit.noise.dark_current import (
    black_level,
    dark_current,
    dark_current_from_variance,
    dark_current_temperature,
    dark_signal_hidden,
    dark_temperature_c,
    read_noise,
    remark_on_temperatures,
)
from lab.fit.noise.emva1288 import EmvaInput, emva1288_figures
from lab.fit.noise.evaluation import Evaluation, evaluate, in_electrons
from lab.fit.noise.response import (
    full_well,
    linearity_by_plane,
    linearity_error,
    main_lamp_levels,
    quantum_efficiency,
    remark_on_scatter,
    variance_curvature_figures,
)
from lab.formats.cgats import TableRow, table_rows
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import (
    CameraFit,
    ChannelNoise,
    Emva1288,
    FitResult,
    NoiseFit,
    PhotonTransfer,
    RepeatDrift,
    Skipped,
)
from lab.formats.results.plausible import implausible_figures
from lab.observables.acquisition_errors import alike_planes, copied_frames, exchanged_frames
from lab.observables.codes.step import find_code_step, under_highest_code
from lab.observables.darks.pixels import PixelFigures
from lab.observables.flats.stated_light import StatedLight, lamps_of, light_of, most_frequent_gain_db, why_not
from lab.observables.noise.levels import MeasuredLevel
from lab.observables.noise.repeats import find_drifts
from lab.observables.noise.side_levels import dark_levels, flat_statistics, grouped
from lab.observables.noise.stack import PlaneStatistics
from lab.observables.noise.surface import DEFECT_SIGMA
from lab.observables.weighted_lines import chi2_factor, root
from sim.camera import Side

# Fixed pattern: DSNU, PRNU, and the symmetry of the shading.


ASYMMETRY = 0.002  # difference of the light on opposite edges, of the mean, above which it is reported


def dsnu(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return DSNU, e, and its standard deviation: the spatial standard deviation of the dark pattern over K."""
    pattern = dark_pattern(evaluation)
    if pattern is None or dark_signal_hidden(evaluation):
        return None, None
    level, square, std = pattern
    if min(level.plane[name].temporal_variance for name in evaluation.levels.names) < evaluation.levels.hidden_dn2:
        std = float(np.hypot(std, evaluation.levels.quantisation_dn2))  # the mean of each pixel is rounded
    return in_electrons(evaluation, *root(square, std))


def prnu(evaluation: Evaluation) -> tuple[float | None, float | None]:
    """Return PRNU, %, and its standard deviation: sqrt(pattern variance - dark pattern variance) / signal, of the flat
    nearest to half of saturation, mean over the planes.
    """
    dark = dark_pattern(evaluation)
    dark_variance = max(dark[1], 0.0) if dark else 0.0
    values, stds, levels = [], [], []
    for name in evaluation.levels.names:
        candidates = []
        for level, clipped in zip(evaluation.levels.flats, evaluation.saturation.clipped[name], strict=True):
            plane = level.plane[name]
            signal = plane.mean - evaluation.dark.mean_dn(name, level.exposure_s)
            share = signal / evaluation.saturation.signal_dn[name]
            if clipped or plane.repeats < 2 or share < 0.1:
                continue
            candidates.append((0.3 <= share <= 0.7, plane.repeats, -abs(share - 0.5), signal, plane))
        if not candidates:
            continue
        _, _, distance, signal, plane = max(candidates, key=lambda c: c[:3])
        spread, spread_std = root(plane.pattern_variance - dark_variance, plane.pattern_variance_std)
        values.append(100.0 * spread / signal)
        stds.append(100.0 * spread_std / signal)
        levels.append((distance, plane.defects))
    if not values:
        evaluation.remarks.add(
            "no unsaturated flats above 10 % of saturation: the PRNU isn't determined; expose longer"
        )
        return None, None
    farthest = -min(levels)[0]
    if farthest > 0.2:
        evaluation.remarks.add(
            f"PRNU comes from flats as far as {100 * farthest:.0f} % from half of saturation, where it should be taken"
        )
    outliers = sum(count for _, count in levels) - evaluation.levels.defects
    if outliers > 0:
        evaluation.remarks.add(
            f"{outliers} pixels respond more than {DEFECT_SIGMA:g} standard deviations off: left out of PRNU"
        )
    weight = 1.0 / np.maximum(np.array(stds), 1e-9) ** 2
    value = float(np.sum(weight * values) / weight.sum())
    chi2 = float(np.sum(weight * (np.array(values) - value) ** 2))
    return value, float(np.sqrt(chi2_factor(chi2, len(values) - 1) / weight.sum()))


def dark_pattern(evaluation: Evaluation) -> tuple[MeasuredLevel, float, float] | None:
    """Return the darks that determine the fixed pattern best (most repeats, then shortest), its variance, DN^2, and the
    standard deviation of that.
    """
    repeated = [level for level in evaluation.levels.darks if level.repeats > 1]
    if not repeated:
        return None
    level = max(repeated, key=lambda level: (level.repeats, -level.exposure_s))
    planes = [level.plane[name] for name in evaluation.levels.names]
    pixels = np.array([plane.pixels for plane in planes], float)
    pixels /= pixels.sum()
    value = float(pixels @ [plane.spatial_variance for plane in planes])
    return level, value, float(np.sqrt(np.sum((pixels * [plane.spatial_variance_std for plane in planes]) ** 2)))


def remark_on_shading(evaluation: Evaluation) -> None:
    """Report light that differs between opposite edges: cos^4 doesn't, a lamp off the axis or a decentred lens does."""
    edges: list[tuple[float, ...]] = []
    for level in evaluation.levels.flats:
        for name in evaluation.levels.names:
            plane = level.plane[name]
            share = (plane.mean - evaluation.dark.lines[name].black) / evaluation.saturation.signal_dn[name]
            if 0.3 <= share <= 0.7 and not evaluation.saturation.clipped[name][evaluation.levels.flats.index(level)]:
                lift = plane.mean / (plane.mean - evaluation.dark.lines[name].black)
                edges.append(
                    tuple(1.0 + lift * (ratio - 1.0) for ratio in (*plane.shading_rows, *plane.shading_columns))
                )
    if not edges:
        return
    first_row, last_row, first_col, last_col = np.mean(edges, axis=0)
    slopes = [
        f"{axis} from {first:.3f} in their first tenth to {last:.3f} in their last"
        for axis, first, last in (("rows", first_row, last_row), ("columns", first_col, last_col))
        if abs(last - first) > ASYMMETRY
    ]
    if slopes:
        evaluation.remarks.add(f"the flats' shading is asymmetric: {'; '.join(slopes)}, of the mean")


# The noise fit of one camera: all figures, by channel too, with the points of its plots.


def noise_fit(
    darks: Sequence[MeasuredLevel],
    flats: Sequence[MeasuredLevel],
    camera: DataSheet,
    gain_db: float = 0.0,
    defects: int = 0,
    pixels: PixelFigures | None = None,
) -> NoiseFit:
    """Return the noise fit on the statistics of levels; the method: `lab.fit.noise`.

    `defects`: number of pixels that were left out of all levels; `pixels`: single pixels in the darks. Raises
    `NotDetermined` where fewer than three unsaturated flat levels have repeats.
    """
    if pixels is not None:
        defects = pixels.number or defects
    return _result(evaluate(darks, flats, camera, gain_db, defects, tuple(flats[0].plane)), pixels)


def _result(evaluation: Evaluation, pixels: PixelFigures | None) -> NoiseFit:
    """All figures. The order of the steps is that of the remarks."""
    t = evaluation.transfer
    scale = 10.0 ** (-evaluation.levels.gain_db / 20.0)
    remark_on_scatter(evaluation)
    remark_on_levels(evaluation)
    remark_on_shading(evaluation)
    remark_on_temperatures(evaluation)
    principal = principal_figures(evaluation)
    figures: dict[str, Any] = principal | quantum_efficiency(evaluation)
    from_variance, from_variance_std = dark_current_from_variance(evaluation)
    of_pixels = pixels.at_gain(t.gain) if pixels is not None and evaluation.levels.darks else PixelFigures()
    return NoiseFit(
        **figures,
        conversion_gain_at_zero_dn_per_e=t.curve_gain * scale,
        conversion_gain_at_zero_dn_per_e_std=t.curve_gain_std * scale,
        variance_model_error_percent=100.0 * t.model_error,
        **variance_curvature_figures(evaluation),
        dark_current_from_variance_e_per_s=from_variance,
        dark_current_from_variance_e_per_s_std=from_variance_std,
        dark_temperature_c=dark_temperature_c(evaluation),
        dark_current_temperature=dark_current_temperature(evaluation),
        read_noise_distribution=of_pixels.noise,
        defects=of_pixels.defects,
        inconsistent_levels=evaluation.consistency.inconsistent,
        response_scatter_percent=100.0 * evaluation.consistency.scatter,
        channels=channel_figures(evaluation, principal),
        emva1288=emva1288_by_plane(evaluation),
        photon_transfer=photon_transfer_points(evaluation, linearity_by_plane(evaluation)[1]),
        remarks=tuple(evaluation.remarks.sentences),
    )


def principal_figures(evaluation: Evaluation) -> dict[str, float | None]:
    """Return the figures that stand for the sensor and for each channel, with their standard deviations."""
    scale = 10.0 ** (-evaluation.levels.gain_db / 20.0)
    figures: dict[str, tuple[float | None, float | None]] = {
        "conversion_gain_dn_per_e": (evaluation.transfer.gain * scale, evaluation.transfer.gain_std * scale),
        "read_noise_e": read_noise(evaluation),
        "black_level_dn": black_level(evaluation),
        "dark_current_e_per_s": dark_current(evaluation),
        "dsnu_e": dsnu(evaluation),
        "prnu_percent": prnu(evaluation),
        "full_well_e": full_well(evaluation),
        "linearity_error_percent": linearity_error(evaluation),
    }
    values = {name: value for name, (value, _) in figures.items()}
    return values | {f"{name}_std": std for name, (_, std) in figures.items()}


def channel_figures(evaluation: Evaluation, principal: dict[str, float | None]) -> dict[str, ChannelNoise]:
    """Return the figures of each colour by itself; a channel that its levels don't determine is reported instead."""
    noise_of_channel: dict[str, ChannelNoise] = {}
    for channel in dict.fromkeys(name[0] for name in evaluation.levels.names):
        planes_of_channel = tuple(name for name in evaluation.levels.names if name[0] == channel)
        try:
            part = (
                principal
                if planes_of_channel == evaluation.levels.names
                else principal_figures(
                    evaluate(
                        evaluation.levels.all_darks,
                        evaluation.levels.flats,
                        evaluation.levels.camera,
                        evaluation.levels.gain_db,
                        0,
                        planes_of_channel,
                    )
                )
            )
        except NotDetermined as refused:
            evaluation.remarks.add(f"channel {channel} alone: {refused.reason}")
            continue
        noise_of_channel[channel] = ChannelNoise(**part)
    return noise_of_channel


def emva1288_by_plane(evaluation: Evaluation) -> dict[str, Emva1288]:
    """Compute the figures as specified in EMVA 1288, by plane; what a plane lacks is reported."""
    figures_of_plane: dict[str, Emva1288] = {}
    main = sorted(main_lamp_levels(evaluation), key=lambda level: level.light)
    lamp = main[0].lamp
    photons = isinstance(lamp, tuple) and len(lamp) == 3 and bool(lamp[1])
    for name in evaluation.levels.names:
        given = EmvaInput(
            plane=name,
            darks=tuple(evaluation.levels.darks),
            flats=tuple(level for level in main if level.light > 0),
            in_photons=photons,
            wavelength_nm=lamp[2] if photons and isinstance(lamp, tuple) else None,
            saturation_dn=evaluation.saturation.signal_dn[name],
            variance_error=evaluation.transfer.model_error,
            lamp_error=evaluation.light_scatter,
            spatial=tuple(level for level in evaluation.levels.flats if level.lamp == lamp and level.light > 0),
            gain_dn_per_e=evaluation.transfer.gain,
        )
        figures = emva1288_figures(given)
        if isinstance(figures, str):
            evaluation.remarks.add(f"no EMVA 1288 figures: {figures}")
        else:
            figures_of_plane[name] = figures
    return figures_of_plane


def photon_transfer_points(evaluation: Evaluation, deviation: dict[tuple[int, str], float]) -> PhotonTransfer:
    """Return the points of the plot: flats by channel, means over the planes of the channel."""
    used = {
        (id(level), name): bool(flag)
        for (level, name), flag in zip(evaluation.points, evaluation.transfer.used, strict=True)
    }
    rows: list[tuple[str, float, float, float, float, float, bool, float | None]] = []
    channels = dict.fromkeys(name[0] for name in evaluation.levels.names)
    for level in evaluation.levels.flats:
        for channel in channels:
            names = [name for name in evaluation.levels.names if name[0] == channel and level.repeats > 1]
            if not names:
                continue
            planes = [level.plane[name] for name in names]
            signal = [p.mean - evaluation.dark.mean_dn(n, level.exposure_s) for p, n in zip(planes, names, strict=True)]
            index = [evaluation.plane_index.get(n) for n in names]
            floor = [0.0 if i is None else float(evaluation.transfer.floor[i]) for i in index]
            dark = [
                f
                + evaluation.transfer.gain
                * (evaluation.dark.mean_dn(n, level.exposure_s) - evaluation.dark.lines[n].black)
                for f, n in zip(floor, names, strict=True)
            ]
            variance = [evaluation.levels.pixel_variance_dn2(level, n) - d for n, d in zip(names, dark, strict=True)]
            shares = [deviation[id(level), n] for n in names if (id(level), n) in deviation]
            rows.append(
                (
                    channel,
                    level.exposure_s,
                    float(np.mean(signal)),
                    float(np.sqrt(np.sum([p.mean_std**2 for p in planes])) / len(names)),
                    float(np.mean(variance)),
                    float(np.sqrt(np.sum([p.temporal_variance_std**2 for p in planes])) / len(names)),
                    all(used.get((id(level), n), False) for n in names),
                    float(np.mean(shares)) if shares else None,
                )
            )
    return PhotonTransfer(
        **dict(zip(PhotonTransfer.model_fields, (tuple(column) for column in zip(*rows, strict=True)), strict=True))
    )


def remark_on_levels(evaluation: Evaluation) -> None:
    """Report saturated and single flats, defects, gain, and planes that differ."""
    clipped = sum(any(flags) for flags in zip(*evaluation.saturation.clipped.values(), strict=True))
    if clipped:
        evaluation.remarks.add(
            f"{clipped} of {len(evaluation.levels.flats)} flat levels saturate in a channel: left out there"
        )
    single = sum(level.repeats < 2 for level in evaluation.levels.flats)
    if single:
        evaluation.remarks.add(
            f"{single} of {len(evaluation.levels.flats)} flat levels have no repeat: only their means are used"
        )
    if evaluation.levels.defects:
        evaluation.remarks.add(
            f"{evaluation.levels.defects} hot or dead pixels stand out of the longest darks: left out of everything"
        )
    if evaluation.levels.gain_db:
        evaluation.remarks.add(
            f"recorded at a gain of {evaluation.levels.gain_db:g} dB: the conversion gain is given for 0 dB"
        )
    remark_on_planes(evaluation)


def remark_on_planes(evaluation: Evaluation) -> None:
    """Report planes that differ in conversion gain, as read-out channels of their own do."""
    values, weights = [], []
    for name in evaluation.levels.names:
        used_flats = [
            (level.plane[name], level)
            for (level, plane), used in zip(evaluation.points, evaluation.transfer.used, strict=True)
            if plane == name and used and level.lamp != "dark"
        ]
        if not used_flats or evaluation.transfer.by_line:
            continue
        signal = np.array([p.mean - evaluation.dark.lines[name].black for p, _ in used_flats])
        variance = np.array([evaluation.levels.pixel_variance_dn2(level, name) for _, level in used_flats])
        excess = variance - evaluation.transfer.floor[evaluation.plane_index[name]]
        excess -= evaluation.transfer.curvature * signal**2
        weight = (
            signal
            / np.hypot([p.temporal_variance_std for p, _ in used_flats], evaluation.transfer.model_error * excess)
        ) ** 2
        values.append(float(np.sum(weight * excess / signal) / weight.sum()))
        weights.append(float(weight.sum()))
    if len(values) < 2:
        return
    mean = np.average(values, weights=weights)
    if special.chdtrc(len(values) - 1, float(np.sum(np.array(weights) * (np.array(values) - mean) ** 2))) < 1e-4:
        listed = ", ".join(f"{name} {value:.4g}" for name, value in zip(evaluation.levels.names, values, strict=False))
        evaluation.remarks.add(f"the planes differ in conversion gain ({listed} DN/e): the one given is their mean")


# The noise fit of a recording set: darks and flats of one camera, grouped into levels.


MIN_SIZE_PX = 16


def fit_noise(recordings: RecordingSet, side: Side, drifts: Sequence[RepeatDrift] | None = None) -> NoiseFit:
    """Fit the photon transfer of one camera to its darks and flats (two repeats or more per level).

    Flats and darks of the most frequent `gain_db` are used; the conversion gain is given for 0 dB. `drifts`: of the
    side's repeats over time, None: they are looked for. No more than one level is held in memory. Raises
    `NotDetermined` where the flats don't determine the conversion gain. The method: `lab.fit.noise`.
    """
    camera = recordings.camera(side)
    flats = recordings.captures(FlatCapture, side)
    if not flats:
        raise NotDetermined("noise", "no flats: capture two or more at each of several exposures up to saturation")
    if min(camera.rows, camera.cols) < MIN_SIZE_PX:
        raise NotDetermined(
            "noise",
            f"{camera.rows} x {camera.cols} px are too few for a variance: give frames of {MIN_SIZE_PX} x "
            f"{MIN_SIZE_PX} or more",
        )
    copies = copied_frames(recordings, side, [*recordings.captures(DarkCapture, side), *flats])
    if copies.ids:
        recordings = recordings.without(copies.ids)
    exchanged = exchanged_frames(recordings, side)
    if exchanged is not None:
        recordings = recordings.without(set(exchanged.captures))
    flats = recordings.captures(FlatCapture, side)
    gain_db = most_frequent_gain_db(flats)
    darks = recordings.captures(DarkCapture, side)
    other_gains = _at_other_gains([*flats, *darks], gain_db)
    flats = [flat for flat in flats if (flat.gain_db or 0.0) == gain_db]
    darks = [dark for dark in darks if (dark.gain_db or 0.0) == gain_db]
    if drifts is None:
        drifts = find_drifts(recordings, side, ("dark",))
    code = find_code_step(recordings, side)
    recordings = under_highest_code(recordings, side, code)
    camera = recordings.camera(side)
    measured = dark_levels(recordings, darks, flats, code.step_dn).with_drifts(drifts)
    light = light_of(flats, camera)
    lamps = _lamps_of(recordings, flats, light)
    flat_levels = [
        MeasuredLevel(
            group[0].exposure_s,
            light[group[0].id].amount,
            lamps[group[0].id],
            flat_statistics(recordings, group, measured, code.step_dn),
            group[0].temperature_c,
            tuple(flat.id for flat in group),
            light[group[0].id].std,
            light[group[0].id].calibration_std,
        )
        for group in grouped(flats, lambda flat: (flat.exposure_s, light[flat.id].amount, lamps[flat.id]))
    ]
    alike = alike_planes(recordings, side)
    mishaps = (
        *other_gains,
        *copies.told,
        *(finding.told(side) for finding in (exchanged, alike) if finding is not None),
    )
    try:
        fitted = noise_fit(measured.levels, flat_levels, camera, gain_db, pixels=measured.pixels)
    except NotDetermined as refused:
        raise NotDetermined("noise", "; ".join((*mishaps, refused.reason))) from refused
    reason = why_not(flats, camera)
    remarks = (*mishaps, *code.lines, *fitted.remarks, *(() if reason is None else (reason,)))
    return fitted.model_copy(update={"remarks": remarks, "gain_db": gain_db})


def _at_other_gains(captures: Sequence[Capture], gain_db: float) -> list[str]:
    """Return a remark on the darks and flats that aren't fitted, as they aren't of the gain of most flats."""
    others = [capture for capture in captures if (capture.gain_db or 0.0) != gain_db]
    if not others:
        return []
    listed = []
    for group in grouped(others, lambda capture: (capture.kind, capture.gain_db)):
        kind, gain = group[0].kind, group[0].gain_db
        stated = "without gain_db (taken as 0 dB)" if gain is None else f"at {gain:g} dB"
        ids = group[0].id if len(group) == 1 else f"{group[0].id} .. {group[-1].id}"
        listed.append(f"{len(group)} {kind}{'s' if len(group) > 1 else ''} {stated} ({ids})")
    what = ", ".join(listed)
    return [f"fitted at {gain_db:g} dB, the gain of most flats: {what} left out; fit them in a set of their own"]


def _lamps_of(
    recordings: RecordingSet, flats: Sequence[FlatCapture], light: Mapping[str, StatedLight]
) -> dict[str, Hashable]:
    """Return the lamp of each flat, by its id. A lamp that is measured before every pass over the levels is one lamp;
    measured photons compare whatever the lamp."""
    names = lamps_of(recordings, flats)
    measured = {flat.id for flat in flats if light[flat.id].unit == "photons" and flat.photons_per_pixel is None}
    return {
        flat.id: (None if flat.id in measured or flat.radiance is None else names[flat.radiance], *light[flat.id].lamp)
        for flat in flats
    }


#
# One row a level and channel, CSV with a header. Columns: `kind` (dark, flat), `exposure_s`, `mean_dn`, `variance_dn2`
# (temporal, of single pixels), `pixels` (of the channel, over which both were taken), `repeats` (frames); where known
# `channel` (Y, R, G, B), `photons_per_pixel`, `wavelength_nm`, `temperature_c`. A table holds no pattern: DSNU, PRNU
# and what needs frames stay unknown.


NEEDED = ("kind", "exposure_s", "mean_dn", "variance_dn2", "pixels", "repeats")
KNOWN = (*NEEDED, "channel", "photons_per_pixel", "wavelength_nm", "temperature_c")
#: Standard deviations below the highest code from which on a level clips.
CLIPPED_SIGMA = 4.0
#: What a table can't tell, by its name in the results.
SPATIAL = ("dsnu", "prnu", "spatial")

Setting = tuple[str, float, float | None, float | None, float | None]


def fit_level_table(file: Path, camera: DataSheet) -> FitResult:
    r"""Fit the photon transfer to a table of levels, without frames.

    file : CSV, a row a level and channel: `kind` (dark, flat), `exposure_s`, `mean_dn`, `variance_dn2` (temporal, of
        single pixels), `pixels`, `repeats`; where known `channel`, `photons_per_pixel`, `wavelength_nm`,
        `temperature_c`
    camera : its `cfa`, `bit_depth` and levels

    Raises InputError with one line where a column is missing or unknown (another unit, above all) or a cell is no
    number, and `NotDetermined` where the levels don't determine the conversion gain. The method: EMVA 1288,
    `lab.fit.noise`.

    >>> from tempfile import TemporaryDirectory
    >>> rows = ["kind,exposure_s,mean_dn,variance_dn2,pixels,repeats", "dark,0.001,64,4,1000000,50"]
    >>> rows += [f"flat,{n / 1000},{64 + 500 * n},{4 + 0.5 * 500 * n},1000000,50" for n in range(1, 8)]
    >>> camera = DataSheet(rows=1000, cols=1000, cfa="MONO", bit_depth=12)
    >>> with TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "levels.csv").write_text("\n".join(rows))
    ...     noise = fit_level_table(Path(folder) / "levels.csv", camera).cameras["left"].noise
    >>> round(noise.conversion_gain_dn_per_e, 3), round(noise.read_noise_e, 2)  # sqrt(4 DN^2 - 1/12) / 0.5 DN/e
    (0.5, 3.96)
    """
    groups: dict[Setting, dict[str, PlaneStatistics]] = {}
    for row in table_rows(file, NEEDED, KNOWN):
        channel = row.cells.get("channel") or ("Y" if camera.cfa == "MONO" else "")
        if channel not in camera.channels:
            raise InputError(
                f"{file}: row {row.number}: channel '{channel}' of a {camera.cfa} sensor; write "
                f"{', '.join(camera.channels)}"
            )
        setting, plane = _level(row, camera)
        if channel in groups.setdefault(setting, {}):
            raise InputError(
                f"{file}: row {row.number}: channel {channel} of this level stands twice; take one row out"
            )
        groups[setting][channel] = plane
    darks: list[MeasuredLevel] = []
    flats: list[MeasuredLevel] = []
    for (kind, exposure_s, photons, wavelength_nm, temperature_c), planes in groups.items():
        if set(planes) != set(camera.channels):
            raise InputError(
                f"{file}: {kind} of {exposure_s:g} s: channels {', '.join(planes)}; give all of "
                f"{', '.join(camera.channels)}"
            )
        dark = kind == "dark"
        light = 0.0 if dark else exposure_s if photons is None else photons
        lamp: Hashable = "dark" if dark else (None, photons is not None, wavelength_nm)
        (darks if dark else flats).append(MeasuredLevel(exposure_s, light, lamp, planes, temperature_c))
    if not flats:
        raise InputError(f"{file}: no flats; give three levels or more")
    fitted = _without_patterns(noise_fit(darks, flats, camera))
    reason = "a table of means and variances holds no frames"
    skipped = tuple(Skipped(step=step, reason=reason, side="left") for step in ("spectral", "mtf", "psf", "geometry"))
    fit = FitResult(source=str(file), cameras={"left": CameraFit(noise=fitted)}, skipped=skipped)
    return fit.model_copy(update={"warnings": implausible_figures(fit, {"left": camera})})


def _level(row: TableRow, camera: DataSheet) -> tuple[Setting, PlaneStatistics]:
    kind = row.cells["kind"]
    if kind not in ("dark", "flat"):
        raise InputError(f"{row.file}: row {row.number}: kind '{kind}'; write dark or flat")
    mean, variance = row.value("mean_dn"), row.value("variance_dn2")
    if mean > camera.saturation_dn:
        raise InputError(
            f"{row.file}: row {row.number}: mean_dn = {mean:g} is above the highest code {camera.saturation_dn:g}; "
            "correct one"
        )
    pixels, repeats = int(row.value("pixels", 1.0)), int(row.value("repeats", 1.0))
    is_clipped = mean > camera.saturation_dn - CLIPPED_SIGMA * math.sqrt(variance) - 0.5
    std = variance * math.sqrt(2.0 / (max(repeats - 1, 1) * pixels))
    side = max(round(math.sqrt(pixels)), 2)
    plane = PlaneStatistics(
        pixels=pixels, mean=mean, frame_means=(mean,) * repeats,
        temporal_variance=variance if repeats > 1 else math.nan,
        temporal_variance_std=std, spatial_variance=0.0, spatial_variance_std=0.0, pattern_variance=0.0,
        pattern_variance_std=0.0, defects=0,
        clipped_share=1.0 if is_clipped else 0.0, piled_share=0.0, zero_share=0.0, highest=mean, shape=(side, side),
        mean_of_all=mean,
        temporal_variance_of_all=variance,
        mean_frame_variance=variance / repeats,
    )  # fmt: skip
    setting = (
        kind,
        row.value("exposure_s"),
        row.known("photons_per_pixel"),
        row.known("wavelength_nm"),
        row.known("temperature_c", -273.15),
    )
    return setting, plane


def _without_patterns(fit: NoiseFit) -> NoiseFit:
    """Return the fit less the figures that need frames."""

    def empty_spatial(part: NoiseFit | ChannelNoise | Emva1288) -> dict[str, object]:
        return {name: None for name in type(part).model_fields if name.startswith(SPATIAL)}

    channels = {c: part.model_copy(update=empty_spatial(part)) for c, part in fit.channels.items()}
    figures = {}
    for c, part in fit.emva1288.items():
        remarks = tuple(text for text in part.remarks if not text.startswith("the spatial stacks"))
        figures[c] = part.model_copy(update=empty_spatial(part) | {"remarks": remarks})
    remark = "of a table of means and variances: DSNU, PRNU, shading and defects aren't determined"
    update = empty_spatial(fit) | {"channels": channels, "emva1288": figures, "remarks": (*fit.remarks, remark)}
    return fit.model_copy(update=update)
