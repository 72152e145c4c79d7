"""A sensor without colour filters that is stated with a mosaic."""

from __future__ import annotations

from lab.diagnose.measurements.linearity import PHOTON_TRANSFER
from lab.diagnose.metadata.misstatement import Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.measure.mishaps import ALIKE, alike_planes
from sim.camera import Side


def misstated_mosaic(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a stated mosaic whose planes are alike in every light (`lab.measure.mishaps`); None where they differ. The
    maker's curves are of colours, and are left out."""
    found = alike_planes(recordings, side)
    if found is None:
        return None
    return Misstatement(
        measurement=PHOTON_TRANSFER,
        where=f"{found.lights} light{'s' if found.lights > 1 else ''}",
        shape="the stated mosaic contradicts planes that are alike",
        check=found.told(side),
        # planes of colours differ by more than `ALIKE`
        chi2_stated=3.0 * found.lights * (ALIKE / max(found.largest, 1e-3 * ALIKE)) ** 2,
        chi2_corrected=3.0 * found.lights,
        n=3 * found.lights,
        captures=found.captures,
        corrected=restated_camera(recordings, side, cfa="MONO", quantum_efficiency=None),
    )
