"""The step of a camera's codes: 1 DN, or more where fewer bits are stored left-aligned or scaled to more.

It is found from the frames, whatever a manifest states: rounding to multiples of a step s has a variance of s^2 / 12.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.formats.recording_set import CodeCounts, RecordingSet
from sim.camera import Side

#: Share of the pixels whose codes may be none of the step: pixels that were replaced after the conversion.
OFF_SHARE = 1e-3
#: Shares of the pixels whose codes, the most frequent first, give the step in turn.
CORE_SHARES = (0.9, 0.99, 1.0)
#: Probability that codes of a step of 1 DN look like those of a larger one by chance.
CHANCE = 1e-6
#: Frames that are looked at, at most: evenly over the settings.
MOST_FRAMES = 64


@dataclass(frozen=True)
class CodeStep:
    """Step of the codes of one camera, DN, and the rest that all codes have modulo a whole step.

    `coarser`: captures whose own step, `their_step_dn`, is larger than that of all frames together: of another setting,
    or of a converter whose steps grow.
    """

    step_dn: float = 1.0
    offset_dn: int = 0
    coarser: tuple[str, ...] = ()
    their_step_dn: float = 1.0

    def highest_dn(self, limit_dn: float) -> float:
        """Return the highest code up to `limit_dn`: 65520 of multiples of 16 in 16 bits."""
        if self.step_dn == 1.0 or not self.step_dn.is_integer():
            return limit_dn
        return limit_dn - (limit_dn - self.offset_dn) % self.step_dn

    @property
    def lines(self) -> tuple[str, ...]:
        """What was found, in one line each; none of codes of 1 DN."""
        found = []
        if self.step_dn > 1.0:
            exact = self.step_dn.is_integer()
            bits = round(float(np.log2(self.step_dn)))
            aligned = f", as codes shifted up by {bits} bits are" if exact and 2**bits == self.step_dn else ""
            found.append(
                f"the codes lie {self.step_dn:.5g} DN apart{aligned}: rounding counts with this step (a variance of "
                f"{self.step_dn**2 / 12.0:.3g} DN^2), and levels in DN are those of the stored codes"
            )
        if self.coarser:
            more = f" and {len(self.coarser) - 3} more" if len(self.coarser) > 3 else ""
            found.append(
                f"the codes of {', '.join(self.coarser[:3])}{more} lie {self.their_step_dn:.5g} DN apart, those of the "
                f"other frames {self.step_dn:.5g} DN: rounding counts with {self.step_dn:.5g} DN; give frames of one "
                "read-out mode and bit depth"
            )
        return tuple(found)


def find_code_step(recordings: RecordingSet, side: Side) -> CodeStep:
    """Return the step of the codes of `side`, from one frame of each setting, of `MOST_FRAMES` settings at most."""
    first: dict[str, Capture] = {}
    for capture in recordings.captures(side=side):
        setting = capture.model_dump(mode="json", exclude={"id", "frame", "time", "temperature_c"})
        first.setdefault(json.dumps(setting, sort_keys=True), capture)
    chosen = list(first.values())
    if len(chosen) > MOST_FRAMES:
        chosen = [chosen[int(k)] for k in np.linspace(0, len(chosen) - 1, MOST_FRAMES).round()]
    parts: list[CodeCounts] = []
    own: dict[str, float] = {}
    for capture in chosen:
        counts = recordings.codes(capture).every
        own[capture.id] = step_of(counts, has_one_mode=isinstance(capture, DarkCapture))
        parts.append(counts)
    total = CodeCounts.total(parts)
    step_dn = step_of(total, has_one_mode=all(isinstance(capture, DarkCapture) for capture in chosen))
    coarser = {id: step for id, step in own.items() if step >= 2.0 * step_dn}
    frequent_dn = int(total.code_dn[np.argmax(total.number)]) if total.number.size else 0
    offset_dn = frequent_dn % int(step_dn)
    return CodeStep(step_dn, offset_dn, tuple(coarser), max(coarser.values(), default=1.0))


def under_highest_code(recordings: RecordingSet, side: Side, code: CodeStep) -> RecordingSet:
    """Return the recordings with the highest code of the step as the camera's white level."""
    camera, manifest = recordings.camera(side), recordings.manifest
    highest_dn = code.highest_dn(camera.saturation_dn)
    if highest_dn == camera.saturation_dn:
        return recordings
    cameras = manifest.cameras | {side: camera.model_copy(update={"white_level_dn": highest_dn})}
    return recordings.under(manifest.model_copy(update={"cameras": cameras}))


def step_of(counts: CodeCounts, *, has_one_mode: bool = False) -> float:
    """Return the step of codes of which `counts` come, DN; 1 where they don't tell.

    The greatest common divisor g of the differences of the frequent codes is the step, where almost all pixels have
    codes of it. Codes that were scaled to more bits and rounded have g = 1, but no two nearer than their step d: then
    it is the mean of the differences of d and d + 1. The highest code isn't looked at: full scale may be no multiple.

    Codes of a step of 1 DN that lie anywhere have n codes in one class modulo g by a chance of g^(1 - n), and no two of
    n codes over a range R nearer than d by one of exp(-n^2 (d - 1) / R). The step counts where that is below `CHANCE`.
    `has_one_mode`: the pixels' distribution has one mode, as that of a dark. Then a code between the most frequent and
    another is expected at least as often as that other, and none comes by a chance of exp(-count): three codes suffice.
    """
    last = None if has_one_mode else -1
    codes, number = (values[:last].astype(np.int64) for values in (counts.code_dn, counts.number))
    if codes.size < 2:
        return 1.0
    frequent = np.argsort(-number, kind="stable")
    covered = np.cumsum(number[frequent])
    for share in CORE_SHARES:
        core = np.sort(codes[frequent[: int(np.searchsorted(covered, share * covered[-1])) + 1]])
        apart = np.diff(core)
        if not apart.size:
            continue
        common, nearest = int(np.gcd.reduce(apart)), int(apart.min())
        if common > 1:
            on = (codes - core[0]) % common == 0
            is_sure = (np.count_nonzero(on) - 1) * np.log(common) > -np.log(CHANCE)
            if has_one_mode and np.count_nonzero(on) > 2:
                is_sure = is_sure or float(np.sort(number[on])[:-1].sum()) > -np.log(CHANCE)
            step_dn = float(common)
        else:
            off = np.abs(codes[:, None] - core[np.searchsorted(core, codes).clip(1, core.size - 1)[:, None] - [1, 0]])
            on = (off.min(axis=1) == 0) | (off.min(axis=1) >= nearest)
            is_sure = core.size**2 * (nearest - 1) / float(core[-1] - core[0]) > -np.log(CHANCE)
            step_dn = float(apart[apart <= nearest + 1].mean())
        if is_sure and number[~on].sum() <= OFF_SHARE * covered[-1]:
            return step_dn
    return 1.0
