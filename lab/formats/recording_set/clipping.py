"""Clipped pixels: their share of each channel, and whether a saturated flat is the top of an exposure series."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.formats.recording_set.frame_files import Frame
from lab.formats.recording_set.manifest import DataSheet
from lab.formats.recording_set.recordings import RecordingSet

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


def channel_planes(frame: Frame, camera: DataSheet) -> dict[str, list[Frame]]:
    """Return the planes of each channel: two for `G`, the whole frame for `Y`."""
    step = 1 if camera.cfa == "MONO" else 2
    planes: dict[str, list[Frame]] = defaultdict(list)
    for row in range(step):
        for col in range(step):
            plane = frame[row::step, col::step]
            if plane.size:
                planes["Y" if step == 1 else camera.cfa[2 * row + col]].append(plane)
    return planes


def clipped_share(frame: Frame, camera: DataSheet) -> dict[str, float]:
    """Share of each channel's pixels at the channel's highest code, if that is above half of the range, else at the
    white level.

    The highest code counts because a sensor whose full well lies below the converter's range saturates below
    `white_level_dn`. Photon noise never puts half of the pixels on one code, so a share above `CLIPPED_LIMIT` means
    saturation in both cases."""
    black = camera.black_level_dn or 0.0
    middle = black + (camera.saturation_dn - black) / 2
    shares = {}
    for channel, planes in channel_planes(frame, camera).items():
        highest = max(float(plane.max()) for plane in planes)
        at = highest if highest > middle else camera.saturation_dn
        shares[channel] = sum(int(np.count_nonzero(plane >= at)) for plane in planes) / sum(p.size for p in planes)
    return shares


def _light(recordings: RecordingSet, flat: FlatCapture) -> tuple[float, str]:
    """Return the light of a flat, and the name of its scale: photons, exposure times radiance, or exposure alone."""
    if flat.photons_per_pixel is not None:
        at = "" if flat.wavelength_nm is None else f" at {flat.wavelength_nm:g} nm"
        return flat.photons_per_pixel, f"{PHOTONS}{at}"
    if flat.radiance is None:
        return flat.exposure_s, "exposure"
    spectrum = recordings.spectrum(flat.radiance)
    return flat.exposure_s * float(np.trapezoid(spectrum.value, spectrum.wavelength_nm)), "radiance"


def flat_level(recordings: RecordingSet, flat: FlatCapture, frame: Frame, clipped: dict[str, float]) -> ClippedLevel:
    """Return the level of one flat. Raises InputError where its spectrum can't be used."""
    light, scale = _light(recordings, flat)
    planes = channel_planes(frame, recordings.camera(flat.side))
    mean_dn = {name: float(np.mean([plane.mean() for plane in planes[name]])) for name in planes}
    scatter_dn = {name: float(np.mean([plane.std() for plane in planes[name]])) for name in planes}
    where = f"{recordings.where(flat.frame)} (capture {flat.id})"
    return ClippedLevel(flat.id, where, flat.gain_db, light, scale, mean_dn, clipped, scatter_dn)


def _why_not_series_end(level: ClippedLevel, channel: str, levels: list[ClippedLevel], black: float) -> str | None:
    """Why the clipped `channel` of a flat isn't the top of an exposure series, with the remedy; None where it is.

    EMVA 1288 asks for exposures up to and beyond saturation. A clipped flat is accepted where at least `SERIES_LEVELS`
    unclipped levels of the same gain and light lie below it, their slope predicts that it clips, and its repeats clip
    too."""
    unclipped = [
        other
        for other in levels
        if (other.gain_db, other.scale) == (level.gain_db, level.scale) and other.clipped[channel] <= CLIPPED_LIMIT
    ]
    wrong = {*map(id, contradicting_levels(unclipped, channel, black)), *_bent_levels(unclipped, channel)}
    unclipped = [other for other in unclipped if id(other) not in wrong]
    for other in unclipped:
        if other.light >= level.light and other.clipped[channel] < CLIPPED_LIMIT / 5:
            return f"but {other.id} with as much light isn't; recapture it"
    below = sorted((other for other in unclipped if 0 < other.light < level.light), key=lambda other: other.light)
    if len({other.light for other in below}) < SERIES_LEVELS:
        return f"expose shorter, or add {SERIES_LEVELS} unsaturated levels below it"
    slope = float(np.median([(other.mean_dn[channel] - black) / other.light for other in below[-SERIES_LEVELS:]]))
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
    for other in unclipped:
        if other.light > 0 and id(other) not in bent:
            signals.setdefault(other.light, other.mean_dn[channel])
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
        other
        for other in unclipped
        if other.light > 0
        and not (id(other) in bent and other.mean_dn[channel] < offset + slope * other.light)
        and abs(other.mean_dn[channel] - offset - slope * other.light)
        > max((1.0 - 1.0 / WRONG_FACTOR) * max(slope * other.light, other.mean_dn[channel] - offset), 0.1 * span)
    ]
    return off if len({other.light for other in off}) <= WRONG_SHARE * light.size else []


def _bent_levels(levels: list[ClippedLevel], channel: str) -> set[int]:
    """Ids of the levels of one gain and light at or beyond the bend at the top of the response."""
    found: set[int] = set()
    greatest = 0.0
    for level in sorted(levels, key=lambda level: level.mean_dn[channel]):
        if level.scatter_dn[channel] < BENT_SCATTER * greatest:
            found.add(id(level))
        greatest = max(greatest, level.scatter_dn[channel])
    return found


def wrong_lights(levels: list[ClippedLevel], camera: DataSheet) -> Iterator[str]:
    """One line for each level of flats whose stated light contradicts the others."""
    for key in dict.fromkeys((level.gain_db, level.scale) for level in levels):
        own = [level for level in levels if (level.gain_db, level.scale) == key]
        for channel in own[0].clipped:
            unclipped = [level for level in own if level.clipped[channel] <= CLIPPED_LIMIT]
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
    found: list[list[ClippedLevel]] = []
    for level in levels:
        for of in found:
            if abs(of[0].light - level.light) <= SAME_LIGHT * of[0].light:
                of.append(level)
                break
        else:
            found.append([level])
    return found


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
