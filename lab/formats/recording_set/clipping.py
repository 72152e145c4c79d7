"""Clipped pixels: their share of each channel, and whether a saturated flat is the top of an exposure ladder."""

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
#: Least number of unsaturated levels below a saturated flat for it to be the top of an exposure ladder.
LADDER_LEVELS = 3
#: Least share of the flat's signal that these levels must predict for it. Below 1, as lamps and sensors aren't exactly linear.
LADDER_REACH = 0.85


@dataclass(frozen=True)
class ClippedLevel:
    """Level of one flat: mean and clipped share of each channel."""

    id: str
    where: str
    gain_db: float | None
    light: float  # proportional to the photons; comparable between flats of the same `scale`
    scale: str
    mean_dn: dict[str, float]
    clipped: dict[str, float]


def channel_planes(frame: Frame, camera: DataSheet) -> dict[str, list[Frame]]:
    """The planes of each channel: two for `G`, the whole frame for `Y`."""
    step = 1 if camera.cfa == "MONO" else 2
    planes: dict[str, list[Frame]] = defaultdict(list)
    for row in range(step):
        for col in range(step):
            plane = frame[row::step, col::step]
            if plane.size:
                planes["Y" if step == 1 else camera.cfa[2 * row + col]].append(plane)
    return planes


def clipped_share(frame: Frame, camera: DataSheet) -> dict[str, float]:
    """Share of each channel's pixels at the channel's highest code, if that is above half of the range, else at the white level.

    The highest code counts because a sensor whose full well lies below the converter's range saturates below `white_level_dn`.
    Photon noise never puts half of the pixels on one code, so a share above `CLIPPED_LIMIT` means saturation in both cases.
    """
    black = camera.black_level_dn or 0.0
    middle = black + (camera.saturation_dn - black) / 2
    shares = {}
    for channel, planes in channel_planes(frame, camera).items():
        highest = max(float(plane.max()) for plane in planes)
        at = highest if highest > middle else camera.saturation_dn
        shares[channel] = sum(int(np.count_nonzero(plane >= at)) for plane in planes) / sum(p.size for p in planes)
    return shares


def _light(recordings: RecordingSet, flat: FlatCapture) -> tuple[float, str]:
    """The light of a flat, and the name of its scale: photons, exposure times radiance, or exposure alone."""
    if flat.photons_per_pixel is not None:
        return flat.photons_per_pixel, f"photons at {flat.wavelength_nm}"
    if flat.radiance is None:
        return flat.exposure_s, "exposure"
    spectrum = recordings.spectrum(flat.radiance)
    return flat.exposure_s * float(np.trapezoid(spectrum.value, spectrum.wavelength_nm)), "radiance"


def flat_level(recordings: RecordingSet, flat: FlatCapture, frame: Frame, clipped: dict[str, float]) -> ClippedLevel:
    """The level of one flat. Raises InputError where its spectrum can't be used."""
    light, scale = _light(recordings, flat)
    planes = channel_planes(frame, recordings.camera(flat.side))
    mean_dn = {name: float(np.mean([plane.mean() for plane in planes[name]])) for name in planes}
    where = f"{recordings.where(flat.frame)} (capture {flat.id})"
    return ClippedLevel(flat.id, where, flat.gain_db, light, scale, mean_dn, clipped)


def _why_not_a_ladder(level: ClippedLevel, channel: str, levels: list[ClippedLevel], black: float) -> str | None:
    """Why the clipped `channel` of a flat isn't the top of an exposure ladder, with the remedy; None where it is.

    EMVA 1288 asks for exposures up to and beyond saturation. A clipped flat is accepted where at least `LADDER_LEVELS` unclipped
    levels of the same gain and light lie below it, their slope predicts that it clips, and its repeats clip too.
    """
    unclipped = [
        other
        for other in levels
        if (other.gain_db, other.scale) == (level.gain_db, level.scale) and other.clipped[channel] <= CLIPPED_LIMIT
    ]
    for other in unclipped:
        if other.light >= level.light and other.clipped[channel] < CLIPPED_LIMIT / 5:
            return f"but {other.id} with as much light isn't; recapture it"
    below = sorted((other for other in unclipped if 0 < other.light < level.light), key=lambda other: other.light)
    if len({other.light for other in below}) < LADDER_LEVELS:
        return f"expose shorter, or add {LADDER_LEVELS} unsaturated levels below it"
    slope = float(np.median([(other.mean_dn[channel] - black) / other.light for other in below[-LADDER_LEVELS:]]))
    if slope * level.light < LADDER_REACH * (level.mean_dn[channel] - black):
        return f"but the flats below it predict {black + slope * level.light:.0f} DN; recapture it"
    return None


def saturated_flats(levels: list[ClippedLevel], camera: DataSheet) -> Iterator[str]:
    """One line for each clipped flat that isn't the top of an exposure ladder."""
    for level in levels:
        for channel, share in level.clipped.items():
            if share <= CLIPPED_LIMIT:
                continue
            if why := _why_not_a_ladder(level, channel, levels, camera.black_level_dn or 0.0):
                yield f"{level.where}: saturated flat, {100 * share:.0f} % of the {channel} pixels are clipped; {why}"
                break
