"""The session that is to come: the plan's captures with the changes, drawn by the model, so that the measuring layer
can look at them."""

from __future__ import annotations

from typing import Any

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import InputError
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.recording_set.files import MemoryFiles
from lab.twin.changes import Changes, light_factor
from lab.twin.relative_light import EVEN
from sim.camera import CameraModel, Side
from sim.frame import Exposure, dark_electrons, expected_electrons, is_steady, read_out
from sim.scene import colorchecker
from sim.scene.scenes import EdgeRegion, KnifeEdge, Scene, UniformField
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.spectrum import Spectrum
from sim.uniform import electron_rate

#: Kinds of captures whose measurements a twin predicts.
PREDICTED = (DarkCapture, FlatCapture, ChartCapture, SlantedEdgeCapture)
#: Seed of the drawn noise: the same model and plan give the same prediction.
SEED = 1288
#: Percentiles of an edge's region that stand for its sides, and the most of the dark one over the light one.
EDGE_PERCENTILES, MOST_DARK_SHARE = (10.0, 90.0), 0.9
#: What model and plan have to agree in.
SENSOR = ("rows", "cols", "cfa", "bit_depth")


def future_session(
    content: CameraFile,
    plan: RecordingSet,
    side: Side,
    changes: Changes,
    seed: int = SEED,
    dn_per_photon: float | None = None,
) -> RecordingSet:
    """Return the captures of one side that a twin predicts, with `changes`, as `content` draws them. `dn_per_photon`:
    the level of flats of which only the photons are stated. Raises InputError where the plan is of another camera,
    doesn't say where its edges are, or holds several gains."""
    stated = plan.camera(side)
    check_sensor(content, stated, plan.source)
    captures = [_change_settings(c, changes) for c in plan.captures(side=side) if isinstance(c, PREDICTED)]
    gains = {c.gain_db or 0.0 for c in captures}
    if not captures or len(gains) > 1:
        what = f"{len(gains)} gains" if captures else "no darks, flats, charts or edges"
        raise InputError(f"{plan.source}: {what} of the {side} camera; plan these captures, at one gain_db")
    lamp, factor = changes.spectrum(), light_factor(content, changes)
    paths = {path for c in captures if (path := light_path(c)) is not None}
    spectra = {path: (lamp or plan.spectrum(path)).scale(factor) for path in paths}
    curves = {c: f"twin/{side}-{c}.csv" for c in content.camera.channels}
    spectra |= {path: content.camera.quantum_efficiency[c] for c, path in curves.items()}
    lens = content.camera.lens
    # a lens that isn't stated stays unstated: it is the session's, whatever the model took for it
    of_lens = {"f_number": lens.f_number, "focal_length_mm": lens.focal_length_mm}
    of_lens = {k: v for k, v in of_lens.items() if getattr(stated, k) is not None or changes.changes_lens}
    pitch = {} if stated.pixel_pitch_um is None else {"pixel_pitch_um": content.camera.pixel_pitch_um}
    sheet = stated.model_copy(update={"quantum_efficiency": curves} | of_lens | pitch)
    manifest = plan.manifest.model_copy(update={"cameras": {side: sheet}, "captures": tuple(captures)})
    frames = _draw_frames(content, captures, spectra, plan, seed, dn_per_photon)
    frames |= _charts(content, captures, frames, plan)
    return RecordingSet(manifest, files=MemoryFiles(frames, spectra, {}), source=plan.source)


def check_sensor(content: CameraFile, stated: DataSheet, source: str) -> None:
    """Check that the plan's camera is the model's. Raises InputError where a property of the sensor differs.

    content : the model
    stated : data sheet of the plan
    source : of the plan, for the message

    >>> from lab.formats.camera_file import default_camera
    >>> camera = default_camera()
    >>> sheet = DataSheet.model_validate({name: getattr(camera.camera, name) for name in SENSOR})
    >>> check_sensor(camera, sheet, "my-plan")
    """
    for name in SENSOR:
        if getattr(stated, name) != getattr(content.camera, name):
            raise InputError(
                f"{source}: {name} is {getattr(stated, name)}, the model's is {getattr(content.camera, name)}; give "
                "the plan of this camera"
            )


def light_path(capture: Capture) -> str | None:
    """Return the file of the light before the camera; None in the dark, and where it isn't stated.

    >>> from lab.capture_kinds.dark import DarkCapture
    >>> light_path(DarkCapture(kind="dark", id="dark-1", side="left", frame="dark-1.npy", exposure_s=0.1)) is None
    True
    """
    return getattr(capture, "radiance", None) or getattr(capture, "light_radiance", None)


def _change_settings(capture: Capture, changes: Changes) -> Capture:
    update: dict[str, Any] = {"exposure_s": capture.exposure_s * (changes.exposure_factor or 1.0)}
    if changes.gain_db is not None:
        update["gain_db"] = changes.gain_db
    if changes.temperature_c is not None:
        update["temperature_c"] = changes.temperature_c
    if isinstance(capture, FlatCapture) and capture.photons_per_pixel is not None:
        more = (changes.exposure_factor or 1.0) * (changes.radiance_factor or 1.0)
        update["photons_per_pixel"] = capture.photons_per_pixel * more
    return capture.model_copy(update=update)


def _draw_frames(
    content: CameraFile,
    captures: list[Capture],
    spectra: dict[str, Spectrum],
    plan: RecordingSet,
    seed: int,
    dn_per_photon: float | None,
) -> dict[str, np.ndarray[Any, Any]]:
    """Return a frame (rows, cols), DN, by its path. Captures of one path share one frame."""
    camera, effects, rng = content.camera, content.effects, np.random.default_rng(seed)
    pattern = sensor.FixedPattern.draw(camera, rng)
    start = min((c.time.timestamp() for c in captures if c.time is not None), default=0.0)
    by_frame: dict[str, list[Capture]] = {}
    for capture in captures:
        by_frame.setdefault(capture.frame, []).append(capture)
    frames: dict[str, np.ndarray[Any, Any]] = {}
    kept: tuple[object, Any] = (None, None)
    for path, members in by_frame.items():
        first = members[0]
        elapsed = 0.0 if first.time is None else first.time.timestamp() - start
        scene = _scene(members, spectra, plan, content.camera, dn_per_photon)
        exposure = Exposure(scene, first.exposure_s, first.gain_db or 0.0, first.temperature_c, elapsed, placed="image")
        settings = [c.model_dump(exclude={"id", "frame", "time"}) for c in members]
        key = repr(settings) if is_steady(camera, effects) else path
        if kept[0] != key:
            kept = key, expected_electrons(camera, exposure, effects)
        frames[path] = sensor.sample_from(
            kept[1], camera, rng, pattern, dark_electrons=dark_electrons(camera, exposure, effects),
            gain_db=exposure.gain_db, read_out=read_out(camera, exposure, effects),
        )  # fmt: skip
    return frames


def _scene(
    members: list[Capture],
    spectra: dict[str, Spectrum],
    plan: RecordingSet,
    camera: CameraModel,
    dn_per_photon: float | None,
) -> Scene:
    """Return what stands before the camera. Raises InputError where the plan doesn't tell."""
    first, source = members[0], plan.source
    if isinstance(first, FlatCapture) and first.radiance is None and first.photons_per_pixel is not None:
        if dn_per_photon is None:
            raise InputError(
                f"{source}: {first.id} states photons and no radiance; give the fitted recordings (--fitted), "
                "to which its level is relative"
            )
        level_e = dn_per_photon * first.photons_per_pixel / camera.conversion_gain_dn_per_e
        brightest = max(electron_rate(camera, channel, EVEN) for channel in camera.channels)
        return UniformField(EVEN.scale(level_e / brightest / first.exposure_s), first.kind)
    if not isinstance(first, SlantedEdgeCapture):
        scene = first.scene(spectra.__getitem__)
        if scene is None:
            raise InputError(f"{source}: {first.id} has no radiance; state the light that it will have, or its photons")
        return scene
    regions = []
    for edge in members:
        if not isinstance(edge, SlantedEdgeCapture) or edge.region is None or edge.angle_deg is None:
            raise InputError(f"{source}: {edge.id} has no region and angle_deg; state where its edge will be")
        if edge.light_radiance is None:
            raise InputError(f"{source}: {edge.id} has no light_radiance; state the light that it will have")
        regions.append(EdgeRegion(edge.region, edge.angle_deg))
    light = spectra[first.light_radiance or ""]
    return KnifeEdge(tuple(regions), light.scale(_dark_share(first, camera, plan)), light)


def _read_planned_frame(plan: RecordingSet, capture: Capture) -> np.ndarray[Any, Any] | None:
    """Return the frame that the plan has of a capture; None where it is a plan alone."""
    try:
        return plan.frame(plan.capture(capture.id)).astype(float)
    except (InputError, KeyError, OSError):
        return None


def _dark_share(edge: Capture, camera: CameraModel, plan: RecordingSet) -> float:
    """Light of an edge's dark side over that of its light one, as the plan's frame shows it; 0 without one."""
    frame = _read_planned_frame(plan, edge)
    if frame is None or not isinstance(edge, SlantedEdgeCapture) or edge.region is None:
        return 0.0
    row0, col0, row1, col1 = edge.region
    dark, light = np.percentile(frame[row0:row1:2, col0:col1:2], EDGE_PERCENTILES) - camera.black_level_dn
    return float(np.clip(dark / max(light, 1e-9), 0.0, MOST_DARK_SHARE))


def _charts(
    content: CameraFile, captures: list[Capture], drawn: dict[str, np.ndarray[Any, Any]], plan: RecordingSet
) -> dict[str, np.ndarray[Any, Any]]:
    """Frames of the chart in its surroundings, by path: those that the plan has, at the levels of the drawn ones. What
    stands around the patches sends light into them, and no manifest says what that is."""
    camera, frames = content.camera, {}
    for capture in captures:
        frame = _read_planned_frame(plan, capture) if isinstance(capture, ChartCapture) else None
        if frame is None or not isinstance(capture, ChartCapture):
            continue
        black, new = camera.black_level_dn, drawn[capture.frame].astype(float)
        out = np.empty_like(frame)
        inside = _patch_centres(capture, frame.shape)
        step = mosaic.step(camera.cfa)
        for phases in mosaic.phases(camera.cfa).values():
            mask = np.zeros(frame.shape, bool)
            for row, col in phases:
                mask[row::step, col::step] = True
            there = mask & inside
            factor = (new[there].mean() - black) / max(frame[there].mean() - black, 1e-9)
            out[mask] = black + factor * (frame[mask] - black)
        frames[capture.frame] = np.clip(np.round(out), 0, camera.white_level_dn).astype(drawn[capture.frame].dtype)
    return frames


def _patch_centres(capture: ChartCapture, shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """Mask (rows, cols) of the middles of the patches."""
    corners = np.array(capture.corners)
    rows, cols = colorchecker.grid(capture.chart)
    half = max(1, int(0.2 * np.min(np.ptp(corners, axis=0) / (rows, cols))))
    mask = np.zeros(shape, bool)
    for v, u in np.ndindex(rows, cols):
        x, y = (u + 0.5) / cols, (v + 0.5) / rows
        weights = np.array([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y])
        row, col = np.round(weights @ corners).astype(int)
        mask[max(row - half, 0) : row + half, max(col - half, 0) : col + half] = True
    return mask
