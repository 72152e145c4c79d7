"""A sensor without colour filters that is stated with a mosaic: its planes answer every light alike."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.fit.noise.saturation import CLIPPED_LIMIT
from lab.formats.recording_set import RecordingSet
from sim.camera import Side
from sim.spectrum import FloatArray

#: Share of the signal, and DN, within which planes are alike: colours differ by tens of percent.
ALIKE, ALIKE_DN = 0.005, 0.1
BRIGHT_SHARE = 0.1  # of the range: signal from which on a light counts
#: Of one light, analogue gains may make colours alike; then the variances over the signals differ by as much. Relative, and standard deviations of
#: a variance, within which they are alike.
SAME_GAIN, SAME_GAIN_SIGMA = 0.1, 4.0


@dataclass(frozen=True)
class AlikePlanes:
    """The captures of bright lights in which all planes are alike; `largest`: departure of a plane from their mean, as a share of the signal."""

    stated: str
    lights: int
    largest: float
    captures: tuple[str, ...]

    def told(self, side: Side) -> str:
        """What is stated and what fits, as a sentence."""
        return (
            f"The four planes of the {side} camera answer {self.lights} light{'s' if self.lights > 1 else ''} alike within {100 * self.largest:.2g} %, as "
            f"those of a sensor without colour filters do, but cfa = {self.stated} is stated: correct cfa to MONO, or give frames that weren't made grey."
        )


def alike_planes(recordings: RecordingSet, side: Side) -> AlikePlanes | None:
    """The planes of a stated mosaic, where they are alike in every bright light: of flats and narrowband captures, the brightest frame of
    each light that doesn't clip. None where they differ, or where no light is bright enough.
    """
    camera = recordings.camera(side)
    if camera.cfa == "MONO":
        return None
    darks = recordings.captures(DarkCapture, side)
    black = float(recordings.frame(darks[0]).mean()) if darks else (camera.black_level_dn or 0.0)
    brightest: dict[tuple[Hashable, ...], tuple[float, float, Capture]] = {}
    for capture in (*recordings.captures(FlatCapture, side), *recordings.captures(NarrowbandCapture, side)):
        frame = recordings.frame(capture)
        signal = float(frame.mean()) - black
        light = (capture.kind, getattr(capture, "wavelength_nm", None), getattr(capture, "radiance", None))
        if signal < BRIGHT_SHARE * camera.saturation_dn or (light in brightest and signal <= brightest[light][0]):
            continue
        if float(np.mean(frame >= camera.saturation_dn)) > CLIPPED_LIMIT:
            continue
        means = np.array([plane.mean() for plane in _planes(np.asarray(frame, float))])
        brightest[light] = signal, float(np.abs(means - means.mean()).max()), capture
    if not brightest or any(away > ALIKE * signal + ALIKE_DN for signal, away, _ in brightest.values()):
        return None
    lights = {light[:2] for light in brightest}  # a lamp may be read before every pass
    if len(lights) == 1 and not _same_gain(recordings, side, max(brightest.values(), key=lambda one: one[0])[2]):
        return None
    return AlikePlanes(
        camera.cfa,
        len(lights),
        max(away / signal for signal, away, _ in brightest.values()),
        tuple(capture.id for _, _, capture in brightest.values()),
    )


def _planes(frame: FloatArray) -> Sequence[FloatArray]:
    even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
    return [even[row::2, col::2] for row in (0, 1) for col in (0, 1)]


def _same_gain(recordings: RecordingSet, side: Side, capture: Capture) -> bool:
    """Whether the planes have one temporal variance in a capture and a repeat of it; False without a repeat."""
    setting = (capture.kind, capture.exposure_s, capture.gain_db)
    repeats = [
        c for c in recordings.captures(side=side) if c.id != capture.id and (c.kind, c.exposure_s, c.gain_db) == setting
    ]
    if not repeats:
        return False
    one, other = (_planes(np.asarray(recordings.frame(c), float)) for c in (capture, repeats[0]))
    variance = np.array([float((a - b).var()) for a, b in zip(one, other, strict=True)])
    within = max(SAME_GAIN, SAME_GAIN_SIGMA * float(np.sqrt(2.0 / one[0].size)))
    return bool(np.all(np.abs(variance / variance.mean() - 1.0) <= within))
