"""Fits: the parameters of a camera from its recordings, with their uncertainties. `fit_recording_set` runs all of
them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.formats.results import CameraFit, FitResult, GeometryFit, Skipped, StereoFit
from lab.one_blas_thread import one_blas_thread
from sim.camera import Side

#: Called with what was just done and the share of the work that is done, 0..1; from any thread, one call at a time.
Progress = Callable[[str, float], None]
T = TypeVar("T")
WORKERS = 2
STEPS = ("noise", "spectral", "mtf", "psf", "geometry")


class _Run:
    """State common to the steps of one fit: the skipped ones, and the number of those done."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self.total, self.progress = total, progress
        self.done = 0
        self.skipped: list[Skipped] = []
        self.lock = threading.Lock()

    def step(self, name: str, side: Side | None, work: Callable[[], T]) -> T | None:
        """The result of `work`, or None and a line in `skipped` where the recordings don't determine it."""
        result: T | None = None
        try:
            result = work()
        except NotDetermined as refused:
            with self.lock:
                self.skipped.append(Skipped(step=refused.step, reason=refused.reason, side=side))
        with self.lock:
            self.done += 1
            if self.progress:
                self.progress(f"{name} of the {side} camera" if side else name, self.done / self.total)
        return result


@one_blas_thread
def fit_recording_set(recordings: RecordingSet, progress: Progress | None = None) -> FitResult:
    """Run every fit on every side, and the stereo pair. What the recordings don't determine is in `skipped`, with the
    reason.

    Both sides, and the geometry and the radiometry of each side, run at the same time. `progress` is called after each
    step.
    """
    from lab.fit.geometry.recordings import fit_geometry
    from lab.fit.mtf.recordings import fit_mtf
    from lab.fit.noise.recordings import fit_noise
    from lab.fit.psf.recordings import fit_psf_field
    from lab.fit.spectral.recordings import fit_spectral
    from lab.fit.stereo import fit_stereo

    sides = recordings.sides
    run = _Run(len(STEPS) * len(sides) + 1, progress)

    def radiometry(side: Side) -> CameraFit:
        levels = run.step("noise", side, lambda: fit_noise(recordings, side))
        kernels = run.step("psf", side, lambda: fit_psf_field(recordings, side))
        return CameraFit(
            noise=levels,
            spectral=run.step("spectral", side, lambda: fit_spectral(recordings, side, levels)),
            mtf=run.step("mtf", side, lambda: fit_mtf(recordings, side, levels)) or (),
            psf=kernels.kernels if kernels else (),
            psf_field=kernels.parts if kernels else (),
            psf_symmetry=kernels.symmetry if kernels else None,
        )

    def pinhole(side: Side) -> GeometryFit | None:
        return run.step("geometry", side, lambda: fit_geometry(recordings, side))

    with ThreadPoolExecutor(WORKERS, thread_name_prefix="fit") as pool:
        radiometries: dict[Side, Future[CameraFit]] = {side: pool.submit(radiometry, side) for side in sides}
        pinholes = {side: pool.submit(pinhole, side) for side in sides}
        cameras = {
            side: radiometries[side].result().model_copy(update={"geometry": pinholes[side].result()}) for side in sides
        }

    def pair() -> StereoFit:
        both = {side: camera.geometry for side, camera in cameras.items() if camera.geometry is not None}
        if "left" not in both or "right" not in both:
            missing = " and ".join(side for side in ("left", "right") if side not in both)
            raise NotDetermined("stereo", f"no geometry of the {missing} side; capture charuco poses with both cameras")
        return fit_stereo(recordings, both["left"], both["right"])

    found = run.step("stereo", None, pair)
    order = {side: number for number, side in enumerate((*sides, None))}
    steps = {step: number for number, step in enumerate((*STEPS, "stereo"))}
    return FitResult(
        source=recordings.source,
        cameras=cameras,
        stereo=found,
        skipped=tuple(  # independent of the order of the threads
            sorted(run.skipped, key=lambda item: (order[item.side], steps.get(item.step, len(steps))))
        ),
    )
