"""What is looked at: the list of measurements, and one side's evidence made of those that its recordings allow."""

from __future__ import annotations

from collections.abc import Callable

from lab.camera_file import CameraFile
from lab.diagnose.board import BOARD_BLOCKS
from lab.diagnose.converter import code_block
from lab.diagnose.darks import DARK_BLOCKS
from lab.diagnose.edges import edge_block
from lab.diagnose.evidence import Evidence
from lab.diagnose.flicker import flicker_block
from lab.diagnose.neighbours import neighbour_block, variance_block
from lab.diagnose.patches import chart_block, screen_block
from lab.diagnose.pattern import green_block, line_block
from lab.diagnose.screens import SCREEN_BLOCKS
from lab.diagnose.shading import shading_block
from lab.diagnose.stereo import STEREO_BLOCKS
from lab.diagnose.summaries import Block, Study
from lab.diagnose.uniform import linearity_block, narrowband_block
from lab.errors import NotDetermined
from lab.predict import assumptions, camera_model
from lab.recording import RecordingSet
from lab.results import CameraFit, FitResult, Skipped
from sim.camera import Side

#: Makers of blocks, in the order of the report; one that a recording set doesn't allow is left out with a reason.
BLOCKS: tuple[Callable[[Study], Block], ...] = (
    *DARK_BLOCKS,
    linearity_block,
    flicker_block,
    variance_block,
    neighbour_block,
    code_block,
    green_block,
    line_block,
    shading_block,
    narrowband_block,
    chart_block,
    edge_block,
    screen_block,
    *SCREEN_BLOCKS,
    *BOARD_BLOCKS,
    *STEREO_BLOCKS,
)

#: Of the full well: from here on pixels of a noisy level are cut off.
_NEAR_FULL = 0.985


def evidence_of(
    recordings: RecordingSet, side: Side, fit: FitResult | None = None, baseline: CameraFile | None = None
) -> tuple[Evidence | None, tuple[Skipped, ...]]:
    """One side's measurements against its baseline, and what couldn't be looked at; None where nothing could.

    `baseline`: a camera with its effects in place of the maker's word and the fit.
    """
    camera_fit = fit.cameras.get(side) if fit is not None else None
    camera = baseline.camera if baseline else camera_model(recordings, side, camera_fit, maker_curves=True)
    skipped = [
        Skipped(step=f"diagnose {a.quantity}", reason=f"neither stated nor fitted; taken as {a.value}", side=side)
        for a in assumptions(recordings.camera(side))
    ]
    study = Study(recordings, side, camera, _saturation_dn(camera_fit))
    skipped += [Skipped(step="diagnose recordings", reason=reason, side=side) for _, reason in study.stale]
    blocks = []
    for make in BLOCKS:
        try:
            blocks.append(make(study))
        except NotDetermined as refused:
            skipped.append(Skipped(step=f"diagnose {refused.step}", reason=refused.reason, side=side))
    blocks = [b for b in blocks if any(not label.held_out for label in b.labels)]
    always = baseline.effects if baseline is not None else ()
    return (Evidence(tuple(blocks), study.camera, always) if blocks else None), tuple(skipped)


def _saturation_dn(fit: CameraFit | None) -> float | None:
    noise = fit.noise if fit is not None else None
    if noise is None or noise.full_well_e is None or noise.conversion_gain_dn_per_e is None:
        return None
    return (noise.black_level_dn or 0.0) + _NEAR_FULL * noise.full_well_e * noise.conversion_gain_dn_per_e
