"""Diagnoses of small recording sets of the second image former."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from lab.diagnose import diagnose
from lab.formats.recording_set import Manifest, RecordingSet


@pytest.fixture(scope="module")
def edges() -> RecordingSet:
    return recordings_of(
        ConcealedCamera(7, cfa="RGGB", f_number=2.0, rows=280, cols=280), Plan(("dark", "slanted_edge"))
    )


def test_a_subset_is_judged_by_what_it_has(edges: RecordingSet) -> None:
    result = diagnose(edges)
    assert result.verdict == "no_mismatch"
    assert {s.step for s in result.skipped} >= {
        "diagnose narrowband",
        "diagnose chart",
        "diagnose photon_transfer",
        "diagnose screen",
    }
    assert result.held_out is not None
    assert set(result.held_out.captures) <= {c.id for c in edges.manifest.captures}


def test_nothing_to_judge_is_said(edges: RecordingSet) -> None:
    camera: dict[str, Any] = edges.camera("left").model_dump()
    camera["f_number"] = None
    keep = [c for c in edges.manifest.captures if c.kind == "slanted_edge"]
    bare = RecordingSet(
        Manifest.model_validate({"cameras": {"left": camera}, "captures": [c.model_dump() for c in keep]}),
        {c.frame: np.array(edges.frame(c)) for c in keep},
        {
            str(p): edges.spectrum(str(p))
            for p in [*dict.fromkeys(c.light_radiance for c in keep), *camera["quantum_efficiency"].values()]
        },
    )
    result = diagnose(bare)
    assert result.verdict == "nothing_judged"
    assert not result.mismatches
    assert "determine no measurement" in result.summary[0]
    assert result.next_capture is not None
    assert "dark frames" in result.next_capture
    assert result.held_out is None
    assert any("f-number" in s.reason for s in result.skipped)
