"""Checks of a whole recording set: every problem and every warning, one line each."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.base import Capture, Names, Open, names_in
from lab.capture_kinds.charuco import CharucoCapture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.errors import InputError
from lab.formats.plausible_range import STATED
from lab.formats.recording_set.files import Frame
from lab.formats.recording_set.frame_codes import CodeCounts, FrameCodes
from lab.formats.recording_set.manifest import DataSheet, Findings
from lab.formats.recording_set.recordings import RecordingSet
from sim.camera import CameraModel, Lens, Side
from sim.parameters import read_quantities

# ----------------------------------------------------------------------------------------------------------------------
# Darks and flats that contradict their own names or places: more light without light than with it, and frames moved
# against their rows.


Array = NDArray[np.floating]

#: Share of the range above black by which a dark's mean has to be above a flat's to contradict it: drifts of a black
#: level are smaller.
ABOVE_SHARE = 0.01
#: Difference of temperature beyond which a dark says nothing of a flat, degree C: the dark current doubles in 6 to 8.
ALIKE_C = 5.0
#: Share of the comparable pairs (or, of one dark, of its flats) that have to contradict their names.
MOST_PAIRS = 0.5
#: Fewest rows of a series, and fewest of them with another light after a move by one row.
FEWEST_ROWS, FEWEST_CHANGED = 8, 3
#: Largest ratio of the departures from a line after the move to those before, and least departure before, a share of
#: the signals' range.
BETTER, LEAST_DEPARTURE = 1.0 / 3.0, 0.002


@dataclass(frozen=True)
class FrameLevel:
    """The mean of a dark or a flat. `light`: proportional to its photons, 0 in the dark; comparable between levels of
    one `scale`."""

    id: str
    where: str
    gain_db: float | None
    exposure_s: float
    temperature_c: float | None
    mean_dn: float
    light: float
    scale: str | None  # None: dark
    is_clipped: bool = False


def exchanged_kinds(levels: Sequence[FrameLevel], camera: DataSheet) -> tuple[list[str], list[str]]:
    """(problems, warnings) for darks that are brighter than flats of as long an exposure: light adds, so that none can
    be.

    A problem where that holds of most pairs (the kinds are exchanged), a warning that names the darks where it holds of
    few of them."""
    problems, warnings = [], []
    least_dn = ABOVE_SHARE * (camera.saturation_dn - (camera.black_level_dn or 0.0))
    for gain_db in dict.fromkeys(level.gain_db for level in levels):
        darks = [level for level in levels if level.scale is None and level.gain_db == gain_db]
        flats = [level for level in levels if level.scale is not None and level.gain_db == gain_db]
        if not darks or not flats:
            continue
        alike = np.array([[_comparable(dark, flat) for flat in flats] for dark in darks])
        above = np.subtract.outer([dark.mean_dn for dark in darks], [flat.mean_dn for flat in flats])
        wrong = alike & (above > least_dn)
        if not wrong.any():
            continue
        d, f = np.unravel_index(int(np.argmax(np.where(wrong, above, -np.inf))), above.shape)
        dark, flat = darks[d], flats[f]
        sentence = (
            f"{dark.where}: a dark of {dark.exposure_s:g} s has {dark.mean_dn:.4g} DN, and the flat {flat.id} of "
            f"{flat.exposure_s:g} s has "
            f"{flat.mean_dn:.4g} DN"
        )
        if wrong.sum() > MOST_PAIRS * alike.sum():
            problems.append(
                f"{sentence}, as {wrong.sum()} of {alike.sum()} pairs do: darks and flats are exchanged; correct their "
                "kinds"
            )
            continue
        lit = wrong.sum(axis=1) > MOST_PAIRS * np.maximum(alike.sum(axis=1), 1)
        if lit.any():
            names = [dark_level.id for dark_level, is_lit in zip(darks, lit, strict=True) if is_lit]
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            warnings.append(
                f"{sentence}: light in {len(names)} of {len(darks)} darks ({', '.join(names[:3])}{more}); correct "
                "their kind or take them out"
            )
    return problems, warnings


def _comparable(dark: FrameLevel, flat: FrameLevel) -> bool:
    """Return whether the flat has to be as bright as the dark: as long an exposure at about the same temperature."""
    warmer = (dark.temperature_c is not None and flat.temperature_c is not None) and abs(
        dark.temperature_c - flat.temperature_c
    ) > ALIKE_C
    return flat.exposure_s >= dark.exposure_s * (1.0 - 1e-6) and not warmer


def moved_rows(levels: Sequence[FrameLevel]) -> Iterator[str]:
    """Yield a line for each series of darks and flats whose frames fit the lights of the rows beside them, from a row
    on.

    levels : in the order of their rows, darks with a light of 0

    Means are fitted by a line in the light, as listed and with the frames of the last rows moved by one. Series whose
    light grows by equal steps or factors fit either way without darks and repeats; nothing is reported of them.

    >>> list(moved_rows([]))
    []
    """
    for gain_db, scale in dict.fromkeys((level.gain_db, level.scale) for level in levels if level.scale is not None):
        lit_levels = [
            level
            for level in levels
            if level.gain_db == gain_db and level.scale in (scale, None) and not level.is_clipped
        ]
        light, mean = np.array([level.light for level in lit_levels]), np.array([level.mean_dn for level in lit_levels])
        if len(lit_levels) < FEWEST_ROWS or np.ptp(light) == 0 or np.ptp(mean) == 0:
            continue
        light, mean = light / np.ptp(light), mean / np.ptp(mean)
        before = float(_departures(light, mean, light, mean)[-1])
        moves = [(_departures(light[:-1], mean[:-1], light[1:], mean[:-1]), light[1:] != light[:-1], 0, "below")]
        moves += [(_departures(light[1:], mean[1:], light[:-1], mean[1:]), light[1:] != light[:-1], 1, "above")]
        for after, changes, first, where in moves:
            enough = np.cumsum(changes[::-1])[::-1] >= FEWEST_CHANGED  # rows from here on with another light
            enough = np.append(enough, False)
            start = int(np.argmin(np.where(enough, after, np.inf)))
            if enough[start] and before > LEAST_DEPARTURE and after[start] < BETTER * before:
                level = lit_levels[start + first]
                yield (
                    f"{level.where}: from this row on, frames have the levels of the rows {where} theirs (departures "
                    "from a line in the light "
                    f"{100 * before:.1f} % of the range as listed, {100 * after[start]:.1f} % moved by one row): "
                    "correct the order of the frames"
                )
                break


def _departures(light: Array, mean: Array, moved_light: Array, moved_mean: Array) -> Array:
    """Rms departure (n + 1,) of means from a line in the light, where the first k pairs are `light` and `mean` and
    those from k on are moved."""

    def sums(x: Array, y: Array) -> Array:
        return np.cumsum(
            np.vstack([np.zeros(6), np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])]), axis=0
        )

    first, later = sums(light, mean), sums(moved_light, moved_mean)
    n, x, y, xx, xy, yy = (first + later[-1] - later).T
    across, along = xx - x * x / n, xy - x * y / n
    left = yy - y * y / n - along**2 / np.maximum(across, 1e-300)
    return np.sqrt(np.maximum(left, 0.0) / n)


#: Share of clipped pixels above which a channel's level isn't measured.
CLIPPED_LIMIT = 0.5
#: Scale of a light that is stated as a number of photons.
PHOTONS = "photons"
#: Least number of unsaturated levels below a saturated flat for it to be the top of an exposure series.
SERIES_LEVELS = 3
#: Share of the levels of a light whose stated light may contradict the others: these are left out, and a warning names
#: them.
WRONG_SHARE = 0.2
#: Factor between the stated light of an unsaturated level and that which the others' median slope gives its mean, above
#: which it contradicts them.
WRONG_FACTOR = 1.5
#: Scatter of a plane's pixels over the greatest of the dimmer levels, below which the response bends: noise, PRNU and
#: shading grow with the signal until a full well or a bend of the response holds the pixels together.
BENT_SCATTER = 0.8
#: Relative difference of two lights below which they are one level: readings of a light scatter.
SAME_LIGHT = 0.01
#: Least share of the flat's signal that these levels must predict for it. Below 1, as lamps and sensors aren't exactly
#: linear.
LEAST_PREDICTED = 0.85


@dataclass(frozen=True)
class ClippedLevel:
    """Level of one flat: mean, clipped share, and standard deviation of the pixels within a plane, of each channel."""

    id: str
    where: str
    gain_db: float | None
    light: float  # proportional to the photons; comparable between flats of the same `scale`
    scale: str
    mean_dn: dict[str, float]
    clipped: dict[str, float]
    scatter_dn: dict[str, float]


def clipped_share(codes: FrameCodes, camera: DataSheet) -> dict[str, float]:
    """Share of each channel's pixels at the channel's highest code, if that is above half of the range, else at the
    white level.

    The highest code counts because a sensor whose full well lies below the converter's range saturates below
    `white_level_dn`. Photon noise never puts half of the pixels on one code, so a share above `CLIPPED_LIMIT` means
    saturation in both cases."""
    black = camera.black_level_dn or 0.0
    middle = black + (camera.saturation_dn - black) / 2
    shares = {}
    for channel, cells in codes.channels(camera.cfa).items():
        counts = CodeCounts.total(cells)
        shares[channel] = counts.share_from(counts.highest_dn if counts.highest_dn > middle else camera.saturation_dn)
    return shares


def _light(recordings: RecordingSet, flat: FlatCapture) -> tuple[float, str]:
    """Return the light of a flat, and the name of its scale: photons, exposure times radiance, or exposure alone."""
    if flat.photons_per_pixel is not None:
        at = "" if flat.wavelength_nm is None else f" at {flat.wavelength_nm:g} nm"
        return flat.photons_per_pixel, f"{PHOTONS}{at}"
    if flat.radiance is None:
        return flat.exposure_s, "exposure"
    spectrum = recordings.spectrum(flat.radiance)
    return flat.exposure_s * float(np.trapezoid(spectrum.value, spectrum.wavelength_nm)), f"radiance{_colour(flat)}"


def _colour(flat: FlatCapture) -> str:
    """Return what is stated of a flat's spectrum, as the end of its scale's name: total radiances of different spectra
    aren't comparable."""
    if flat.wavelength_nm is not None:
        return f" at {flat.wavelength_nm:g} nm"
    if flat.colour_temperature_k is not None:
        return f" of {flat.colour_temperature_k:g} K"
    return "" if flat.lamp_levels is None else f" of the channels {', '.join(sorted(flat.lamp_levels))}"


def flat_level(recordings: RecordingSet, flat: FlatCapture, clipped: dict[str, float]) -> ClippedLevel:
    """Return the level of one flat. Raises InputError where its spectrum can't be used."""
    light, scale = _light(recordings, flat)
    camera, codes = recordings.camera(flat.side), recordings.codes(flat)
    cells = codes.channels(camera.cfa)
    mean_dn = {
        name: float(np.mean([codes_of_plane.mean_dn for codes_of_plane in planes])) for name, planes in cells.items()
    }
    scatter_dn = {
        name: float(np.mean([codes_of_plane.std_dn for codes_of_plane in planes])) for name, planes in cells.items()
    }
    where = f"{recordings.where(flat.frame)} (capture {flat.id})"
    return ClippedLevel(flat.id, where, flat.gain_db, light, scale, mean_dn, clipped, scatter_dn)


def _why_not_series_end(level: ClippedLevel, channel: str, levels: list[ClippedLevel], black: float) -> str | None:
    """Why the clipped `channel` of a flat isn't the top of an exposure series, with the remedy; None where it is.

    EMVA 1288 asks for exposures up to and beyond saturation. A clipped flat is accepted where at least `SERIES_LEVELS`
    unclipped levels of the same gain and light lie below it, their slope predicts that it clips, and its repeats clip
    too."""
    unclipped = [
        flat
        for flat in levels
        if (flat.gain_db, flat.scale) == (level.gain_db, level.scale) and flat.clipped[channel] <= CLIPPED_LIMIT
    ]
    wrong = {*map(id, contradicting_levels(unclipped, channel, black)), *_bent_levels(unclipped, channel)}
    unclipped = [flat for flat in unclipped if id(flat) not in wrong]
    for flat in unclipped:
        if flat.light >= level.light and flat.clipped[channel] < CLIPPED_LIMIT / 5:
            return f"but {flat.id} with as much light isn't; recapture it"
    below = sorted(
        (flat for flat in unclipped if 0 < flat.light < level.light),
        key=lambda flat: flat.light,
    )
    if len({flat.light for flat in below}) < SERIES_LEVELS:
        return f"expose shorter, or add {SERIES_LEVELS} unsaturated levels below it"
    slope = float(np.median([(flat.mean_dn[channel] - black) / flat.light for flat in below[-SERIES_LEVELS:]]))
    if slope * level.light < LEAST_PREDICTED * (level.mean_dn[channel] - black):
        return f"but the flats below it predict {black + slope * level.light:.0f} DN; recapture it"
    return None


def contradicting_levels(unclipped: list[ClippedLevel], channel: str, black: float) -> list[ClippedLevel]:
    """Unclipped flats of one gain and light whose stated light contradicts that of the others by more than
    `WRONG_FACTOR`.

    The reference is the median slope of signal against light, which holds while fewer than half of the levels are
    wrong. Empty where more than `WRONG_SHARE` of the levels contradict it: then no majority says what the light is.
    `black`: DN; if unknown, the offset of a robust line through the levels (Theil and Sen). Levels at the full well or
    in the bend at the top of the response don't count for the slope, and less signal than the slope predicts is no
    contradiction there.
    """
    bent = _bent_levels(unclipped, channel)
    signals: dict[float, float] = {}
    for flat in unclipped:
        if flat.light > 0 and id(flat) not in bent:
            signals.setdefault(flat.light, flat.mean_dn[channel])
    light, mean = np.array(list(signals)), np.array(list(signals.values()))
    if light.size < 1 / WRONG_SHARE:
        return []
    first, second = np.triu_indices(light.size, 1)
    slope = float(np.median((mean[second] - mean[first]) / (light[second] - light[first])))
    offset = black if black > 0 else float(np.median(mean - slope * light))
    if slope <= 0:
        return []
    span = float(np.ptp(mean))
    off = [
        flat
        for flat in unclipped
        if flat.light > 0
        and not (id(flat) in bent and flat.mean_dn[channel] < offset + slope * flat.light)
        and abs(flat.mean_dn[channel] - offset - slope * flat.light)
        > max(
            (1.0 - 1.0 / WRONG_FACTOR) * max(slope * flat.light, flat.mean_dn[channel] - offset),
            0.1 * span,
        )
    ]
    return off if len({flat.light for flat in off}) <= WRONG_SHARE * light.size else []


def _bent_levels(levels: list[ClippedLevel], channel: str) -> set[int]:
    """Ids of the levels of one gain and light at or beyond the bend at the top of the response."""
    bent: set[int] = set()
    greatest = 0.0
    for level in sorted(levels, key=lambda level: level.mean_dn[channel]):
        if level.scatter_dn[channel] < BENT_SCATTER * greatest:
            bent.add(id(level))
        greatest = max(greatest, level.scatter_dn[channel])
    return bent


def wrong_lights(levels: list[ClippedLevel], camera: DataSheet) -> Iterator[str]:
    """One line for each level of flats whose stated light contradicts the others."""
    for key in dict.fromkeys((level.gain_db, level.scale) for level in levels):
        levels_of_light = [level for level in levels if (level.gain_db, level.scale) == key]
        for channel in levels_of_light[0].clipped:
            unclipped = [level for level in levels_of_light if level.clipped[channel] <= CLIPPED_LIMIT]
            off = contradicting_levels(unclipped, channel, camera.black_level_dn or 0.0)
            for of in _by_light(off):
                yield (
                    f"{of[0].where}: {len(of)} flats of a stated light of {of[0].light:.6g} ({of[0].scale}) have "
                    f"{of[0].mean_dn[channel]:.4g} DN, "
                    "which contradicts the other levels; the fits judge that; correct the photon number or the exposure"
                )
            if off:
                break
    misplaced = list(_misplaced(levels, camera))
    forgiven = _forgiven(misplaced, levels)
    for first, *_ in _by_light([level for level, *_ in misplaced if id(level) in forgiven]):
        yield (
            f"{first.where}: saturated though its stated {first.light:.6g} photons are fewer than those of levels "
            "that aren't: left out by the "
            "fits; correct the photon number"
        )


def _by_light(levels: list[ClippedLevel]) -> list[list[ClippedLevel]]:
    """Levels of one light together, the first in the set first."""
    groups: list[list[ClippedLevel]] = []
    for level in levels:
        for of in groups:
            if abs(of[0].light - level.light) <= SAME_LIGHT * of[0].light:
                of.append(level)
                break
        else:
            groups.append([level])
    return groups


def saturated_flats(levels: list[ClippedLevel], camera: DataSheet) -> Iterator[str]:
    """One line for each clipped flat that isn't the top of an exposure series, unless its photon number may be
    wrong."""
    misplaced = list(_misplaced(levels, camera))
    forgiven = _forgiven(misplaced, levels)
    for level, channel, why in misplaced:
        if id(level) not in forgiven:
            share = level.clipped[channel]
            yield f"{level.where}: saturated flat, {100 * share:.0f} % of the {channel} pixels are clipped; {why}"


def _misplaced(levels: list[ClippedLevel], camera: DataSheet) -> Iterator[tuple[ClippedLevel, str, str]]:
    """Clipped flats that aren't the top of an exposure series, with the channel and why."""
    for level in levels:
        for channel, share in level.clipped.items():
            if share <= CLIPPED_LIMIT:
                continue
            if why := _why_not_series_end(level, channel, levels, camera.black_level_dn or 0.0):
                yield level, channel, why
                break


def _forgiven(misplaced: list[tuple[ClippedLevel, str, str]], levels: list[ClippedLevel]) -> set[int]:
    """Ids of misplaced flats that state photon numbers, if they are few enough: a stated number may be wrong, unlike an
    exposure."""
    photons = [level for level, *_ in misplaced if level.scale.startswith(PHOTONS)]
    lights = {level.light for level in levels if level.scale.startswith(PHOTONS)}
    few = len({level.light for level in photons}) <= WRONG_SHARE * len(lights)
    return {id(level) for level in photons} if few else set()


#: Share of a channel's pixels at its highest code from which on a flat's mean isn't in proportion to the light.
ANY_CLIPPED = 0.01
#: A warning is given where a narrowband light's centre is off the wavelength set by more than this plus a quarter of
#: its bandwidth.
OFF_NAME_NM = 3.0


#: Called with each capture, its frame, and the share of the captures that are done.
Loaded = Callable[[Capture, Frame, float], None]


def _not_used(capture: Capture, frame: Frame, share: float) -> None:
    """Frames that are checked and not used otherwise."""


def _unknown_keys(where: str, item: Open) -> Iterator[str]:
    for key in item.unknown_keys():
        yield f"{where}: unknown key '{key}' is kept but not used; check its spelling"
    for name, value in item:
        if isinstance(value, Open):
            yield from _unknown_keys(f"{where}, {name}", value)


def _camera_problems(camera: DataSheet) -> Iterator[str]:
    limit = 2**camera.bit_depth - 1
    if camera.white_level_dn is not None and camera.white_level_dn > limit:
        yield (
            f"white_level_dn = {camera.white_level_dn:g} is above what {camera.bit_depth} bits hold ({limit}); "
            "correct one"
        )
    if camera.black_level_dn is not None and camera.black_level_dn >= camera.saturation_dn:
        yield (
            f"black_level_dn = {camera.black_level_dn:g} isn't below the white level {camera.saturation_dn:g}; "
            "correct one"
        )
    for key, quantity in (read_quantities(CameraModel) | read_quantities(Lens)).items():
        value, unit = getattr(camera, key, None), "" if quantity.unit == "1" else f" {quantity.unit}"
        for limit, beyond in ((quantity.lower, "below"), (quantity.upper, "above")):
            if value is not None and limit is not None and (value < limit if beyond == "below" else value > limit):
                yield (
                    f"{key} = {value:g}{unit} is {beyond} the limit of {limit:g}{unit} ({quantity.meaning}); correct "
                    "its value or its unit, or leave it out"
                )
    for channel in camera.quantum_efficiency or {}:
        if channel not in camera.channels:
            yield (
                f"quantum_efficiency of a channel '{channel}', but a {camera.cfa} sensor has "
                f"{', '.join(camera.channels)}; rename it"
            )


def _check_frames(recordings: RecordingSet, findings: Findings, loaded: Loaded) -> None:
    """Load every frame once and hand it to `loaded`; find damaged frames, saturated flats, clipped captures, and darks
    and flats whose levels contradict their kind or their place."""
    flats: dict[Side, list[ClippedLevel]] = defaultdict(list)
    levels: dict[Side, list[FrameLevel]] = defaultdict(list)
    clipped_of: dict[tuple[Side, str], list[str]] = defaultdict(list)
    captures = recordings.manifest.captures
    for number, capture in enumerate(captures, start=1):
        camera = recordings.manifest.cameras[capture.side]
        try:
            frame = recordings.whole_frame(capture)
        except InputError as error:
            findings.problems.append(str(error))
            continue
        loaded(capture, frame, number / len(captures))
        if isinstance(capture, DarkCapture):
            mean_dn = recordings.codes(capture).every.mean_dn
            levels[capture.side].append(_frame_level(recordings, capture, mean_dn, 0.0, None))
        if not capture.clipping_matters:
            continue
        codes = recordings.codes(capture)
        clipped = clipped_share(codes, camera)
        if isinstance(capture, FlatCapture):
            with suppress(InputError):  # a spectrum that can't be used is reported with the spectra
                flat = flat_level(recordings, capture, clipped)
                flats[capture.side].append(flat)
                level = _frame_level(recordings, capture, codes.every.mean_dn, flat.light, flat.scale)
                levels[capture.side].append(replace(level, is_clipped=max(clipped.values()) > ANY_CLIPPED))
        elif max(clipped.values()) > CLIPPED_LIMIT:
            clipped_of[capture.side, capture.kind].append(capture.id)
    for side, of_flats in flats.items():
        findings.problems += saturated_flats(of_flats, recordings.manifest.cameras[side])
        findings.warnings += wrong_lights(of_flats, recordings.manifest.cameras[side])
    for side, of_frames in levels.items():
        problems, warnings = exchanged_kinds(of_frames, recordings.manifest.cameras[side])
        findings.problems += problems
        findings.warnings += [*warnings, *([] if problems else moved_rows(of_frames))]
    for (side, kind), ids in clipped_of.items():
        findings.warnings.append(
            f"{recordings.source}: {len(ids)} {kind} captures of the {side} camera have a channel clipped "
            f"({_some(ids)}); "
            "what a clipped channel saw is not used; expose shorter"
        )


def _frame_level(
    recordings: RecordingSet, capture: Capture, mean_dn: float, light: float, scale: str | None
) -> FrameLevel:
    return FrameLevel(
        capture.id,
        f"{recordings.where(capture.frame)} (capture {capture.id})",
        capture.gain_db,
        capture.exposure_s,
        capture.temperature_c,
        mean_dn,
        light,
        scale,
    )


def _check_cameras(recordings: RecordingSet, findings: Findings) -> None:
    for side, camera in recordings.manifest.cameras.items():
        where = f"{recordings.source}: camera {side}"
        findings.warnings += _unknown_keys(where, camera)
        findings.problems += [f"{where}: {problem}" for problem in _camera_problems(camera)]
        if camera.lens_file is not None:
            try:
                recordings.file(camera.lens_file)
            except InputError as error:
                findings.problems.append(f"{recordings.where(camera.lens_file)} (lens_file of camera {side}): {error}")


def _improbable_values(capture: Capture) -> Iterator[str]:
    """Yield a line for squares of a board that are improbably small or large, and for an improbable temperature: as a
    rule, they are in another unit."""
    stated = {"temperature_c": (capture.temperature_c, "C")}
    if isinstance(capture, CharucoCapture):
        stated["square_mm"] = (capture.square_mm, "mm")
    for key, (value, unit) in stated.items():
        if value is not None and (line := STATED[key].sentence(key, value, None, unit)):
            yield line


def _check_captures(recordings: RecordingSet, findings: Findings) -> None:
    manifest, source = recordings.manifest, recordings.source
    for id, count in Counter(capture.id for capture in manifest.captures).items():
        if count > 1:
            findings.problems.append(f"{source}: capture id '{id}' is used {count} times; give every capture its own")
    framed: dict[str, Capture] = {}
    remarked: dict[str, list[str]] = {}
    for capture in manifest.captures:
        where = f"{source}: capture {capture.id}"
        findings.warnings += _unknown_keys(where, capture)
        camera = manifest.cameras[capture.side]
        findings.problems += [f"{where}: {text}" for text in capture.problems(camera.rows, camera.cols)]
        for text in (*capture.remarks(), *_improbable_values(capture)):
            remarked.setdefault(text, []).append(capture.id)
        first = framed.setdefault(capture.frame, capture)
        if first is not capture and not capture.shares_frame:
            findings.warnings.append(
                f"{where}: its frame is that of {first.id} too, so it is no repeat; check the path"
            )
    for text, ids in remarked.items():
        what = f"capture {ids[0]}" if len(ids) == 1 else f"{len(ids)} captures ({_some(ids)})"
        findings.warnings.append(f"{source}: {what}: {text}")


def _some(ids: Sequence[str]) -> str:
    """Return the first three of some captures and the last."""
    return ", ".join(ids[:3]) + (f" .. {ids[-1]}" if len(ids) > 3 else "")


def _check_spectra_and_targets(recordings: RecordingSet, findings: Findings) -> None:
    manifest = recordings.manifest
    efficiencies = {
        path: f"quantum_efficiency {channel} of camera {side}"
        for side, camera in manifest.cameras.items()
        for channel, path in (camera.quantum_efficiency or {}).items()
    }
    lights: dict[str, str] = {}
    targets: dict[str, str] = {}
    for capture in manifest.captures:
        for key, what, path in names_in(capture):
            if what in (Names.SPECTRUM, Names.TARGET):
                users = lights if what is Names.SPECTRUM else targets
                users.setdefault(path, f"{key} of capture {capture.id}")
    for path, user in [*efficiencies.items(), *lights.items()]:
        where = f"{recordings.where(path)} ({user})"
        try:
            lowest, highest = min(value := recordings.spectrum(path).value), max(value)
        except InputError as error:
            findings.problems.append(f"{where}: {error.__cause__}")
            continue
        if user.startswith("quantum_efficiency") and not 0 <= lowest <= highest <= 1:
            findings.problems.append(
                f"{where}: {lowest:g}..{highest:g} isn't a quantum efficiency of 0..1 electrons a photon; "
                "divide percent by 100"
            )
        elif not user.startswith("quantum_efficiency") and highest <= 0:
            findings.warnings.append(f"{where}: no light at any wavelength; was the shutter open?")
    findings.warnings += _lights_off_their_names(recordings)
    for path, user in targets.items():
        try:
            recordings.target(path)
        except InputError as error:
            findings.problems.append(f"{recordings.where(path)} ({user}): {error.__cause__}")


def _lights_off_their_names(recordings: RecordingSet) -> Iterator[str]:
    """One line that names the narrowband lights whose measured centre isn't the wavelength set.

    The centre is the mean wavelength of the samples above half of the maximum, weighted by the radiance.
    """
    off: dict[str, str] = {}
    for capture in recordings.manifest.captures:
        if not isinstance(capture, NarrowbandCapture) or capture.radiance in off:
            continue
        try:
            wavelength, value = recordings.spectrum(capture.radiance).arrays
        except InputError:  # reported with the spectra
            continue
        if value.max() > 0:
            share = value / value.max()
            above = share > 0.5
            centre_nm = float(np.average(wavelength[above], weights=share[above]))
            if abs(centre_nm - capture.wavelength_nm) > OFF_NAME_NM + 0.25 * (capture.bandwidth_nm or 0.0):
                off[capture.radiance] = f"{capture.wavelength_nm:g} nm: {centre_nm:.1f} nm"
    if off:
        yield (
            f"{recordings.source}: {len(off)} narrowband lights are centred elsewhere than they are set "
            f"({'; '.join(off.values())}); "
            "their measured spectra are used; correct wavelength_nm, or measure again"
        )


def inspect(recordings: RecordingSet, loaded: Loaded = _not_used) -> tuple[list[str], list[str]]:
    """(problems, warnings) of a recording set, one line each. `read` refuses a set with problems.

    Every frame, spectrum and target is read once; frames are handed to `loaded`.
    """
    findings = Findings(warnings=list(_unknown_keys(f"{recordings.source}: manifest", recordings.manifest)))
    _check_cameras(recordings, findings)
    _check_captures(recordings, findings)
    _check_spectra_and_targets(recordings, findings)
    _check_frames(recordings, findings, loaded)
    return findings.problems, findings.warnings
