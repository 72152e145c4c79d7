"""Photon transfer, sensitivity and MTF of a session that is still under way, from the captures that are on disk.

Each capture is looked at once, when it is new: the work of a look is that of the captures since the one before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lab.capture.records import CaptureInfo
from lab.capture.store import Store
from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.capture_kinds.narrowband import NarrowbandCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.errors import InputError, NotDetermined
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.observables.edges.measured import measure_edge
from lab.observables.edges.mtf import read_mtf
from sim.camera import Side
from sim.parameters import Frozen
from sim.sensor.mosaic import first_pixels, planes

BINS = 64


class ChannelFigures(Frozen):
    """One channel of a frame. `row`, `col`: of its first pixel. `counts`: pixels in each of the equal bins between 0
    and the saturation; `saturated_share`: of its pixels, those at or above the data sheet's white level."""

    channel: str
    row: int
    col: int
    mean_dn: float
    saturated_share: float
    counts: tuple[int, ...]


class FrameFigures(Frozen):
    """A frame's channels: R, G1, G2, B, or Y. The bins are `bin_dn` wide and begin at 0 DN."""

    bin_dn: float
    black_level_dn: float | None
    saturation_dn: float
    channels: tuple[ChannelFigures, ...]


def frame_figures(frame: NDArray[np.uint16], camera: DataSheet) -> FrameFigures:
    """Return histogram, mean and saturated share of each plane of a frame: R, G1, G2 and B of a Bayer mosaic.

    frame : (rows, cols), DN
    camera : its data sheet

    >>> sheet = DataSheet(rows=4, cols=4, cfa="RGGB", bit_depth=12)
    >>> [figures.mean_dn for figures in frame_figures(np.full((4, 4), 100, np.uint16), sheet).channels]
    [100.0, 100.0, 100.0, 100.0]
    """
    top = camera.saturation_dn
    bin_dn = (top + 1.0) / BINS
    curves = []
    firsts = first_pixels(camera.cfa)
    for name, plane in planes(frame, camera.cfa).items():
        codes = np.bincount(plane.ravel(), minlength=int(top) + 1)
        at = np.minimum((np.arange(codes.size) / bin_dn).astype(int), BINS - 1)
        curves.append(
            ChannelFigures(
                channel=name,
                row=firsts[name][0],
                col=firsts[name][1],
                mean_dn=float(codes @ np.arange(codes.size) / plane.size),
                saturated_share=float(codes[int(np.ceil(top)) :].sum() / plane.size),
                counts=tuple(np.bincount(at, codes, BINS).astype(int).tolist()),
            )
        )
    return FrameFigures(bin_dn=bin_dn, black_level_dn=camera.black_level_dn, saturation_dn=top, channels=tuple(curves))


#: Captures that one look takes at most: a session that is long under way is looked at in several.
AT_ONCE = 60
FREQUENCIES_CY_PER_PX = np.linspace(0.0, 0.5, 26)


class TransferPoint(Frozen):
    """Two flats of one exposure: the mean above black, and the temporal variance, half that of their difference (EMVA
    1288)."""

    side: Side
    channel: str
    exposure_s: float
    mean_dn: float
    variance_dn2: float
    saturated: bool


class SensitivityPoint(Frozen):
    """A narrowband capture: DN above black per second and per radiance (W sr^-1 m^-2) of the light."""

    side: Side
    channel: str
    wavelength_nm: float
    dn_per_s_and_radiance: float


class EdgeLook(Frozen):
    """A slanted edge in the channel that has most of the pixels: contrast at `frequency_cy_per_px`, by the estimator of
    the fit."""

    side: Side
    region: str
    frequency_cy_per_px: tuple[float, ...]
    mtf: tuple[float, ...]


class Curves(Frozen):
    """What the captures so far show. `looked_at` of `captures` have been looked at."""

    captures: int = 0
    looked_at: int = 0
    transfer: tuple[TransferPoint, ...] = ()
    sensitivity: tuple[SensitivityPoint, ...] = ()
    edges: tuple[EdgeLook, ...] = ()


class GrowingCurves:
    """The curves of one session; `look` brings them up to date."""

    def __init__(self, store: Store, session_id: str) -> None:
        self.store, self.session_id = store, session_id
        self._last = 0
        self._looked_at = 0
        self._flats: dict[tuple[Side, float], NDArray[np.uint16] | None] = {}  # None: the pair is done
        self._seen: set[tuple[Side, str]] = set()
        self._transfer: list[TransferPoint] = []
        self._sensitivity: list[SensitivityPoint] = []
        self._edges: list[EdgeLook] = []

    def look(self) -> Curves:
        """Look at the captures that are new, `AT_ONCE` at most. Raises InputError where the session is gone."""
        new = self.store.captures(self.session_id, after=self._last or None, limit=AT_ONCE)
        for info in new:
            self._one(info)
            self._last = info.id
            self._looked_at += 1
        return Curves(
            captures=sum(self.store.count_captures(self.session_id).values()),
            looked_at=self._looked_at,
            transfer=tuple(self._transfer),
            sensitivity=tuple(self._sensitivity),
            edges=tuple(self._edges),
        )

    def _one(self, info: CaptureInfo) -> None:
        if info.kind not in ("flat", "narrowband", "slanted_edge"):
            return
        try:
            recordings = self.store.recording_set(self.session_id, (info.id,))
            (capture,) = recordings.captures()
            if isinstance(capture, FlatCapture):
                self._flat(recordings, capture)
            elif isinstance(capture, NarrowbandCapture):
                self._narrowband(recordings, capture)
            elif isinstance(capture, SlantedEdgeCapture):
                self._edge(recordings, capture)
        except (InputError, NotDetermined):
            return  # packed away just now, or no edge there: the fit will say

    def _first(self, capture: Capture, what: str) -> bool:
        """Return whether nothing of this side and name was looked at before."""
        key = (capture.side, what)
        fresh = key not in self._seen
        self._seen.add(key)
        return fresh

    def _flat(self, recordings: RecordingSet, capture: FlatCapture) -> None:
        if capture.exposure_s is None:
            return
        key = (capture.side, capture.exposure_s)
        if key in self._flats and self._flats[key] is None:
            return
        frame, before = centre(recordings.frame(capture)), self._flats.get(key)
        self._flats[key] = None if before is not None else frame.copy()
        if before is None:
            return
        camera = recordings.camera(capture.side)
        black, top = camera.black_level_dn or 0.0, camera.saturation_dn
        for name, plane in planes(frame, camera.cfa).items():
            earlier = planes(before, camera.cfa)[name].astype(np.int32)
            difference = plane.astype(np.int32) - earlier
            self._transfer.append(
                TransferPoint(
                    side=capture.side,
                    channel=name,
                    exposure_s=capture.exposure_s,
                    mean_dn=float((plane.mean() + earlier.mean()) / 2.0 - black),
                    variance_dn2=float(difference.var() / 2.0),
                    saturated=bool(np.mean(plane >= top) > 1e-3),
                )
            )

    def _narrowband(self, recordings: RecordingSet, capture: NarrowbandCapture) -> None:
        if not capture.exposure_s or not self._first(capture, f"{capture.wavelength_nm:g} nm"):
            return
        light = recordings.spectrum(capture.radiance)
        radiance = float(np.trapezoid(light.value, light.wavelength_nm))
        if not radiance > 0.0:
            return
        camera = recordings.camera(capture.side)
        for name, plane in planes(centre(recordings.frame(capture)), camera.cfa).items():
            signal = float(plane.mean()) - (camera.black_level_dn or 0.0)
            self._sensitivity.append(
                SensitivityPoint(
                    side=capture.side,
                    channel=name,
                    wavelength_nm=capture.wavelength_nm,
                    dn_per_s_and_radiance=signal / capture.exposure_s / radiance,
                )
            )

    def _edge(self, recordings: RecordingSet, capture: SlantedEdgeCapture) -> None:
        name = f"{capture.region or 'found'}, {capture.angle_deg} deg"  # repeats of an edge have both alike
        if not self._first(capture, name):
            return
        channel = "Y" if recordings.camera(capture.side).cfa == "MONO" else "G"
        mtf = read_mtf(measure_edge(recordings, [capture], channel), FREQUENCIES_CY_PER_PX)
        self._edges.append(
            EdgeLook(
                side=capture.side,
                region=name,
                frequency_cy_per_px=tuple(FREQUENCIES_CY_PER_PX.tolist()),
                mtf=tuple(np.round(mtf.mtf, 5).tolist()),
            )
        )


def centre(frame: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the middle quarter of a frame, beginning at an even row and column, so that the mosaic stays what it is.

    frame : (rows, cols) DN

    >>> centre(np.zeros((480, 640), np.uint16)).shape
    (240, 320)
    """
    rows, cols = frame.shape
    row, col = rows // 4 // 2 * 2, cols // 4 // 2 * 2
    return frame[row : rows - row, col : cols - col]
