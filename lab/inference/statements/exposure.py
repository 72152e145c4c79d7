"""The stated exposure of one setting of dark or of flat frames, or of one pass of it, against those of the others.

Both light and dark current grow with the true exposure: m' = b + f (m - b) of the levels above the black level b, for
the exposure f times as long as stated. Of the temporal variance of darks the part by dark current grows so."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from lab.capture_kinds.base import Capture
from lab.formats.recording_set import RecordingSet
from lab.inference.hypotheses import Coordinate
from lab.inference.statements.statement import AffineChange, Changes, Numbers, Restatement, Statement, Told
from lab.observables.darks.level import DARK
from lab.observables.darks.noise import DARK_NOISE
from lab.observables.flats.linearity import PHOTON_TRANSFER
from lab.observables.observable import Measurement
from sim.camera import Side
from sim.spectrum import FloatArray

#: Prior scale of ln f: a wrong entry is off by tens of percent, and the prior's tail holds factors of a thousand.
SCALE = 0.3
#: Settings with different exposures that there have to be: two tell a line, whatever is stated.
LEAST_SETTINGS = 3

_Setting = tuple[str, float, float | None]


def _setting(capture: Capture) -> _Setting:
    """Return what decides a capture's level: its kind, its exposure, and its number of photons."""
    return capture.kind, float(capture.exposure_s or 0.0), getattr(capture, "photons_per_pixel", None)


def _groups(numbers: Numbers, setting: _Setting) -> list[frozenset[str]]:
    """Return the captures of a setting, and those of each of its passes: runs of captures in time, between which others
    were taken."""
    passes: list[list[str]] = []
    is_run = False
    for capture in numbers.captures.values():
        is_own = _setting(capture) == setting
        if is_own and not is_run:
            passes.append([])
        if is_own:
            passes[-1].append(capture.id)
        is_run = is_own
    whole = frozenset(name for one in passes for name in one)
    return [whole, *(frozenset(one) for one in passes if len(passes) > 1)]


def _restatements(numbers: Numbers) -> Sequence[Restatement]:
    found: list[Restatement] = []
    for measurement in (DARK, PHOTON_TRANSFER):
        used = {c.id: c for _, _, captures in numbers.of(measurement) for c in captures}
        settings = sorted({_setting(c) for c in used.values()}, key=lambda s: s[:2])
        if len({exposure_s for _, exposure_s, _ in settings}) < LEAST_SETTINGS:
            continue
        groups = ((s, ids) for s in settings if s[1] > 0.0 for ids in _groups(numbers, s) if ids & used.keys())
        found += [
            Restatement(
                partial(_on, setting, ids), partial(_told, setting, ids), ((0.1 * SCALE,), (-0.1 * SCALE,)), measurement
            )
            for setting, ids in groups
        ]
    return found


def _on(setting: _Setting, ids: frozenset[str], numbers: Numbers) -> Changes:
    def rows_of(*measurements: Measurement) -> FloatArray:
        return np.array([k for k, label, _ in numbers.of(*measurements) if ids.issuperset(label.captures)], int)

    noise = numbers.model.noise
    assert noise is not None
    levels, variances = rows_of(DARK, PHOTON_TRANSFER), rows_of(DARK_NOISE)
    rows = np.concatenate([levels, variances]).astype(int)
    shot_dn2 = noise.gain * noise.dark_dn_per_s * setting[1]

    def change(u: FloatArray) -> AffineChange:
        more = float(np.expm1(u[0]))
        scale = np.concatenate([np.full(len(levels), 1.0 + more), np.ones(len(variances))])
        offset = np.concatenate([np.full(len(levels), -more * noise.black), np.full(len(variances), more * shot_dn2)])
        return AffineChange(rows, np.diag(scale), offset)

    return change


def _told(
    setting: _Setting, ids: frozenset[str], recordings: RecordingSet, side: Side, u: FloatArray, std: FloatArray
) -> Told:
    kind, exposure_s, _ = setting
    mine = tuple(c.id for c in recordings.captures(side=side) if c.id in ids)
    factor = float(np.exp(u[0]))
    captures = tuple(
        c.model_copy(update={"exposure_s": c.exposure_s * factor}) if c.id in ids and c.exposure_s is not None else c
        for c in recordings.manifest.captures
    )
    frames = "Dark frames" if kind == "dark" else "Flat frames"
    return Told(
        where=f"{exposure_s:.4g} s, {len(mine)} captures",
        shape="a stated exposure contradicts the frames of the others",
        check=f"{frames} of the {side} camera don't lie on one line over their exposures: {mine[0]} .. {mine[-1]}, "
        f"stated with {exposure_s:.6g} s, have the level of {factor * exposure_s:.6g} ± "
        f"{factor * exposure_s * std[0]:.2g} s; correct it, or take these frames again.",
        captures=mine,
        corrected=recordings.under(recordings.manifest.model_copy(update={"captures": captures})),
    )


WRONG_EXPOSURE = Statement(
    "wrong_exposure",
    (
        Coordinate(
            "factor", SCALE, lower=-np.log(1e4), upper=np.log(1e4), typical=SCALE, step=0.02 * SCALE,
            to_value=lambda u: float(np.exp(u)),
        ),
    ),
    _restatements,
)  # fmt: skip
