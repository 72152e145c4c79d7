"""Replay: the captures of a recording set as a camera model predicts (mean frames) or draws them (whole recording
sets).

The forward model of `sim` computes every frame. This module gives it the scene that manifest and recordings determine.
Position of an edge and levels of its two sides are taken from the recorded frame, as no model predicts them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import NotDetermined
from lab.formats.recording_set import RecordingSet
from lab.observables.edges.measured import measure_edge
from lab.observables.edges.profile import EdgeSummary
from sim.camera import CameraModel, Side
from sim.effects.base import Effect
from sim.frame import Exposure, dark_electrons, expected_electrons, is_steady, read_out
from sim.scene.scenes import EdgeRegion, KnifeEdge, Scene
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum

#: Light of equal energy (nm, W sr^-1 m^-2 nm^-1), for edges whose light wasn't measured.
_EQUAL = Spectrum.of((380.0, 780.0), (0.01, 0.01))


class Replay:
    """The captures of one side as a camera model predicts and draws them."""

    def __init__(self, recordings: RecordingSet, side: Side, camera: CameraModel) -> None:
        self.recordings, self.side, self.camera = recordings, side, camera

    @cached_property
    def captures(self) -> tuple[Capture, ...]:
        """The captures that can be predicted, in the manifest's order."""
        return tuple(c for c in self.recordings.captures(side=self.side) if self._tells_its_scene(c))

    def _tells_its_scene(self, capture: Capture) -> bool:
        """Return whether manifest and recordings determine the scene. Of screens and boards they don't tell the
        pose."""
        return isinstance(capture, SlantedEdgeCapture) or capture.scene(lambda path: _EQUAL) is not None

    @cached_property
    def _start(self) -> float | None:
        times = [c.time.timestamp() for c in self.recordings.captures(side=self.side) if c.time is not None]
        return min(times, default=None)

    def expected(self, capture: Capture, effects: Sequence[Effect] = ()) -> FloatArray:
        """Mean frame (rows, cols) in DN. Raises NotDetermined where manifest and recordings don't determine the
        scene."""
        exposure, electrons = self._electrons(capture, effects)
        return sensor.dn_moments(electrons, self.camera, exposure.gain_db, read_out(self.camera, exposure, effects))[0]

    def drawn(self, rng: np.random.Generator, effects: Sequence[Effect] = ()) -> RecordingSet:
        """Return the recordings with the frames of `captures` drawn from the model, with one fixed pattern for all."""
        pattern = sensor.FixedPattern.draw(self.camera, rng)
        frames = {}
        mean: dict[object, tuple[Exposure, FloatArray]] = {}
        for capture in self.captures:
            key = self._scene_key(capture, effects)
            if key not in mean:
                mean = {key: self._electrons(capture, effects)}  # repeats follow one another
            exposure, electrons = mean[key]
            frames[capture.frame] = sensor.sample_from(
                electrons, self.camera, rng, pattern, dark_electrons=dark_electrons(self.camera, exposure, effects),
                gain_db=exposure.gain_db, read_out=read_out(self.camera, exposure, effects),
            )  # fmt: skip
        return self.recordings.with_frames(frames)

    def _scene_key(self, capture: Capture, effects: Sequence[Effect]) -> object:
        statements = capture.model_dump(exclude={"id", "frame", "time"})
        return repr(statements) if is_steady(self.camera, effects) else capture.id

    def _electrons(self, capture: Capture, effects: Sequence[Effect]) -> tuple[Exposure, FloatArray]:
        edge = self._edge(capture) if isinstance(capture, SlantedEdgeCapture) else None
        exposure = Exposure(
            self._scene(capture, edge), capture.exposure_s, capture.gain_db or 0.0, capture.temperature_c,
            0.0 if capture.time is None or self._start is None else capture.time.timestamp() - self._start,
            placed="image",
        )  # fmt: skip
        electrons = expected_electrons(self.camera, exposure, effects)
        if isinstance(capture, SlantedEdgeCapture):
            electrons = self._level(capture, exposure, electrons, effects)
        return exposure, electrons

    def _scene(self, capture: Capture, edge: EdgeSummary | None) -> Scene:
        if isinstance(capture, SlantedEdgeCapture) and edge is not None:
            light = self.recordings.spectrum(capture.light_radiance) if capture.light_radiance else _EQUAL
            dark = Spectrum.of(*(light.arrays[0], 0.0 * light.arrays[1]))
            return KnifeEdge((_place_edge(self._region(capture), edge),), dark, light)
        scene = capture.scene(self.recordings.spectrum)
        if scene is None:
            raise NotDetermined("replay", f"{capture.id} ({capture.kind}) doesn't tell what stood before the camera")
        return scene

    def _edge(self, capture: SlantedEdgeCapture) -> EdgeSummary:
        """Return the edge that the slanted-edge estimator finds in the green (or only) channel."""
        channel = "G" if "G" in self.camera.channels else self.camera.channels[0]
        return measure_edge(self.recordings, [capture], channel)

    def _region(self, capture: SlantedEdgeCapture) -> tuple[int, int, int, int]:
        return capture.region or (0, 0, self.camera.rows, self.camera.cols)

    def _level(
        self, capture: SlantedEdgeCapture, exposure: Exposure, electrons: FloatArray, effects: Sequence[Effect]
    ) -> FloatArray:
        """Electrons with an edge's two levels matched to the recording, channel by channel, by a least squares line
        between predicted and recorded electrons."""
        dark = np.broadcast_to(np.asarray(dark_electrons(self.camera, exposure, effects), float), electrons.shape)
        gain = sensor.gain_dn_per_e(self.camera, exposure.gain_db)
        recorded = (self.recordings.frame(capture).astype(float) - self.camera.black_level_dn) / gain
        row0, col0, row1, col1 = self._region(capture)
        inside = np.zeros(electrons.shape, bool)
        inside[row0:row1, col0:col1] = True
        out = electrons.copy()
        step = mosaic.step(self.camera.cfa)
        for phases in mosaic.phases(self.camera.cfa).values():
            plane = np.zeros(electrons.shape, bool)
            for row, col in phases:
                plane[row::step, col::step] = True
            lit, measured = (electrons - dark)[plane & inside], (recorded - dark)[plane & inside]
            slope, level = np.polyfit(lit, measured, 1)
            out[plane] = np.maximum(slope * (electrons - dark)[plane] + level, 0.0) + dark[plane]
        return out


def _place_edge(region: tuple[int, int, int, int], edge: EdgeSummary) -> EdgeRegion:
    """Return a straight edge at the centre and the angle that the estimator found."""
    row, col = edge.curve.centre
    if edge.curve.transposed:
        row += edge.curve.poly[0]
    else:
        col += edge.curve.poly[0]
    placed = EdgeRegion(region, edge.angle_deg)
    return replace(placed, offset_px=float(placed.distance_px(np.asarray(row), np.asarray(col))))
