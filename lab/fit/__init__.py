"""Fits: the parameters of a camera from its recordings, with their uncertainties. `fit_recording_set` runs all of
them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar, get_args

from lab.capture_kinds.charuco import CharucoCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet, Summaries
from lab.formats.results import CameraFit, FitResult, GeometryFit, Skipped, StereoFit
from lab.formats.results.plausible import implausible_figures
from lab.one_blas_thread import one_blas_thread
from lab.side_processes import in_processes
from sim.camera import Side

#: Called with the step that was just done and the share of the work that is done, 0..1; from any thread, one at a time.
Progress = Callable[[str, float], None]
T = TypeVar("T")
#: The fits of a side, in the order of a result, and that of the pair.
Step = Literal["noise", "spectral", "mtf", "psf", "geometry", "stereo"]
STEPS: tuple[Step, ...] = get_args(Step)
#: The fits that a diagnosis uses. It measures edges and screens by itself.
FOR_DIAGNOSIS: tuple[Step, ...] = ("noise", "spectral", "geometry")
#: Pixels of all frames from which on each side gets a process, which takes 1.5 s to start. Their fits take some 6 s.
WORTH_PROCESSES_PX = 2e7


@dataclass(frozen=True)
class SideFit:
    """The fits of one side, the steps that its recordings don't determine, and the summaries that were made of its
    frames (`RecordingSet.once`)."""

    camera: CameraFit
    skipped: tuple[Skipped, ...]
    summaries: Summaries


@one_blas_thread
def fit_recording_set(
    recordings: RecordingSet, progress: Progress | None = None, steps: Collection[Step] = STEPS
) -> FitResult:
    """Run the fits of `steps`, by default all, on every side and on the stereo pair. Steps that the recordings don't
    determine are listed in `skipped`, with the reason.

    Several sides with many frames are fitted at the same time, each in a process of its own. `progress` is called after
    each step.
    """
    from lab.fit.stereo import fit_stereo

    sides = recordings.sides
    paired = "stereo" in steps
    total, done = len(set(steps) - {"stereo"}) * len(sides) + paired, 0
    lock = threading.Lock()

    def report_step(side: Side | None, step: Step) -> None:
        nonlocal done
        with lock:
            done += 1
            if progress:
                progress(f"{step} of the {side} camera" if side else step, done / total)

    if len(sides) > 1 and _pixels(recordings) > WORTH_PROCESSES_PX:
        tasks = {side: partial(fit_side, recordings.for_one_of(len(sides)), side, steps) for side in sides}
        fitted = in_processes(recordings, tasks, report_step, "fit")
        for side_fit in fitted.values():  # the pair is fitted, and a diagnosis rests, on the same
            recordings.keep(side_fit.summaries)
    else:
        fitted = {side: fit_side(recordings, side, steps, partial(report_step, side)) for side in sides}
    cameras = {side: side_fit.camera for side, side_fit in fitted.items()}

    def pair() -> StereoFit:
        both = {side: camera.geometry for side, camera in cameras.items() if camera.geometry is not None}
        if "left" not in both or "right" not in both:
            missing = " and ".join(side for side in ("left", "right") if side not in both)
            raise NotDetermined("stereo", f"no geometry of the {missing} side; capture charuco poses with both cameras")
        return fit_stereo(recordings, both["left"], both["right"])

    stereo, refused = _step(pair, None) if paired else (None, ())
    if paired:
        report_step(None, "stereo")
    result = FitResult(
        source=recordings.source,
        cameras=cameras,
        stereo=stereo,
        skipped=(*(skipped for side_fit in fitted.values() for skipped in side_fit.skipped), *refused),
    )
    squares_mm = [capture.square_mm for capture in recordings.captures(CharucoCapture)]
    warnings = implausible_figures(result, recordings.manifest.cameras, squares_mm)
    return result.model_copy(update={"warnings": warnings})


def fit_side(
    recordings: RecordingSet, side: Side, steps: Collection[Step], report_step: Callable[[Step], None]
) -> SideFit:
    """Run the fits of `steps` of one side. Geometry runs in a thread of its own. `report_step` is called with each step
    that was done.
    """
    from lab.fit.geometry import fit_geometry
    from lab.fit.mtf import fit_mtf
    from lab.fit.noise.noise_fit import fit_noise
    from lab.fit.psf.recordings import fit_psf_field
    from lab.fit.spectral.recordings import fit_spectral
    from lab.observables.acquisition_errors import exchanged_frames
    from lab.observables.noise.repeats import find_drifts

    skipped: list[Skipped] = []

    def step(name: Step, work: Callable[[], T]) -> T | None:
        if name not in steps:
            return None
        result, refused = _step(work, side)
        skipped.extend(refused)
        report_step(name)
        return result

    def fit_geometry_of_side() -> GeometryFit | None:
        return step("geometry", lambda: fit_geometry(recordings, side))

    with ThreadPoolExecutor(1, thread_name_prefix="fit") as pool:
        geometry = pool.submit(fit_geometry_of_side)
        edges_left_out: list[str] = []
        exchanged = exchanged_frames(recordings, side)
        drifts = find_drifts(recordings, side, left_out=() if exchanged is None else exchanged.captures)
        levels = step("noise", lambda: fit_noise(recordings, side, drifts))
        kernels = step("psf", lambda: fit_psf_field(recordings, side))
        camera = CameraFit(
            noise=levels,
            spectral=step("spectral", lambda: fit_spectral(recordings, side, levels, drifts)),
            mtf=step("mtf", lambda: fit_mtf(recordings, side, levels, edges_left_out)) or (),
            psf=kernels.kernels if kernels else (),
            psf_field=kernels.parts if kernels else (),
            psf_symmetry=kernels.symmetry if kernels else None,
            geometry=geometry.result(),
            repeat_drifts=drifts,
        )
    if camera.mtf:  # else the first is the reason why there is none
        skipped.extend(Skipped(step="mtf", reason=reason, side=side) for reason in edges_left_out)
    # independent of the order of the threads; a fit may name a part of its step
    order: dict[str, int] = {name: number for number, name in enumerate(STEPS)}
    ordered = tuple(sorted(skipped, key=lambda item: order.get(item.step, len(order))))
    return SideFit(camera, ordered, recordings.summaries)


def _step(work: Callable[[], T], side: Side | None) -> tuple[T | None, tuple[Skipped, ...]]:
    """Return the result of a step, or None and why it was skipped where the recordings don't determine it."""
    try:
        return work(), ()
    except NotDetermined as refused:
        return None, (Skipped(step=refused.step, reason=refused.reason, side=side),)


def _pixels(recordings: RecordingSet) -> float:
    """Count the pixels of all frames; a side whose frame size isn't stated counts 0."""
    return float(
        sum(
            len(recordings.captures(side=side))
            * (recordings.camera(side).rows or 0)
            * (recordings.camera(side).cols or 0)
            for side in recordings.sides
        )
    )
