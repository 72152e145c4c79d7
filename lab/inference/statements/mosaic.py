"""The stated order of a mosaic's colours, against how its planes answer lights.

The mean of a stated channel is one of planes that have other colours: of its planes p with the true colours c(p),

    m'_k = 1/|k| sum over p in k of m_c(p)

where m_c is what that colour would have. RGGB and BGGR exchange red and blue; of RGGB and GRBG, stated red is green,
and stated green is half red and half blue."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from lab.formats.recording_set import RecordingSet
from lab.inference.statements.statement import (
    Change,
    Changes,
    Numbers,
    Restatement,
    Statement,
    Told,
    restated_camera,
)
from lab.observables.charts.chart import CHART
from lab.observables.spectra.narrowband import NARROWBAND
from sim.camera import Cfa, Side
from sim.spectrum import FloatArray

MOSAICS: tuple[Cfa, ...] = ("RGGB", "BGGR", "GRBG", "GBRG")


def mixture(stated: Cfa, true: Cfa) -> dict[str, dict[str, float]]:
    """Return, of each stated channel, the shares of its pixels that have each colour."""
    found: dict[str, dict[str, float]] = {}
    for channel, colour in zip(stated, true, strict=True):
        own = found.setdefault(channel, {})
        own[colour] = own.get(colour, 0.0) + 1.0 / stated.count(channel)
    return found


def _restatements(numbers: Numbers) -> Sequence[Restatement]:
    stated = numbers.stated.cfa
    if stated not in MOSAICS or not any(True for _ in numbers.of(NARROWBAND, CHART)):
        return ()
    measurement = NARROWBAND if any(True for _ in numbers.of(NARROWBAND)) else CHART
    return [
        Restatement(partial(_on, stated, cfa), partial(_told, stated, cfa), measurement=measurement)
        for cfa in MOSAICS
        if cfa != stated
    ]


def _on(stated: Cfa, true: Cfa, numbers: Numbers) -> Changes:
    every = [*numbers.of(NARROWBAND, CHART)]
    rows = np.array([k for k, _, _ in every], int)
    at = {(label.captures, label.condition, label.channel): i for i, (_, label, _) in enumerate(every)}
    shares = mixture(stated, true)
    matrix, spread = np.zeros((len(rows), len(rows))), np.zeros(len(rows))
    for i, (k, label, _) in enumerate(every):
        of = {colour: at.get((label.captures, label.condition, colour)) for colour in shares[label.channel]}
        if any(index is None for index in of.values()):  # it clips, or no pixel of a patch has it: any level
            matrix[i, i], spread[i] = 1.0, max(abs(float(numbers.model.value[k])), 1.0)
            continue
        for colour, index in of.items():
            matrix[i, index] = shares[label.channel][colour]
    change = Change(rows, matrix, np.zeros(len(rows)), spread)
    return lambda u: change


def _told(stated: Cfa, true: Cfa, recordings: RecordingSet, side: Side, u: FloatArray, std: FloatArray) -> Told:
    return Told(
        where="all lights",
        shape="the stated mosaic contradicts the colours that its planes see",
        check=f"The planes of the {side} camera answer the lights as a mosaic {true} does, but cfa = {stated} is "
        f"stated: correct cfa to {true}, or crop or turn the frames by even numbers of pixels, and fit again.",
        captures=tuple(c.id for kind in ("narrowband", "chart") for c in recordings.captures(kind, side)),
        corrected=restated_camera(recordings, side, cfa=true),
    )


WRONG_MOSAIC = Statement("wrong_mosaic", (), _restatements)
