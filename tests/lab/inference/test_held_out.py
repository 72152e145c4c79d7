"""Which captures are held out, and Holm's procedure."""

from __future__ import annotations

import numpy as np

from lab.formats.recording_set import Manifest, RecordingSet
from lab.inference.check import held_out_ids, holm


def _recordings(exposures_s: list[float]) -> RecordingSet:
    captures = [
        {
            "id": f"d{k}", "kind": "dark", "side": "left", "frame": f"frames/d{k}.npy", "exposure_s": exposure,
            "time": f"2026-03-02T09:{59 - k:02d}:00Z",
        }
        for k, exposure in enumerate(exposures_s)
    ]  # fmt: skip
    camera = {"rows": 4, "cols": 6, "bit_depth": 12, "cfa": "MONO"}
    manifest = Manifest.model_validate({"name": "darks", "cameras": {"left": camera}, "captures": captures})
    return RecordingSet(manifest, {}, {}, {}, source="darks")


def test_every_third_of_a_setting_in_time_is_held_out() -> None:
    """Times run backwards: of seven captures of one exposure d6 is the first, and the third and the sixth in time are
    d4 and d1. Two captures of another exposure are both used."""
    assert held_out_ids(_recordings([0.1] * 7 + [0.5] * 2), "left") == {"d4", "d1"}


def test_holm_stops_at_the_first_that_passes() -> None:
    """At a rate of 0.06 of four: 0.06 / 4, then 0.06 / 3; the third passes at 0.03, and the rest with it."""
    assert holm(np.array([0.031, 0.001, 0.019, 0.05]), 0.06).tolist() == [False, True, True, False]
