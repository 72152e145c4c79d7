"""ISO 17850:2015: local and line geometric distortion, read from the fitted projection with its covariance.

The standard measures dots or lines of a chart parallel to the sensor. A calibrated projection says where each point of
such a chart would be recorded, so that no chart has to stand parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results import GeometryFit
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardMap, StandardPlot
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.scene.projection import CAMERA, Projection
from sim.spectrum import FloatArray

MAP_ROWS, MAP_COLS = 9, 13
LINE_POINTS = 101
#: Step of a numerical derivative, standard deviations of the parameter.
STEP_SIGMA = 0.5


class Iso17850(Standard):
    """ISO 17850:2015, of one camera."""

    name: ClassVar[str] = "ISO 17850:2015"
    title: ClassVar[str] = "geometric distortion"
    target: ClassVar[str] = "views of a ChArUco board in several poses"
    compared: ClassVar[str] = "OpenCV 5 (`cv2.projectPoints`): local distortion equal to 1e-5 %"
    not_done: ClassVar[tuple[NotDone, ...]] = (
        NotDone("6.2.3", "total line distortion", "its formula was not at hand; both parts are given"),
    )

    def __init__(self, side: MeasuredSide, geometry: GeometryFit) -> None:
        super().__init__(side, "whole frame")
        self.geometry = geometry
        self.projection = Projection(geometry.lens_projection, geometry.spline_angle_deg)
        self.intrinsics = self.projection.intrinsics(geometry.camera_matrix, geometry.distortion)

    @cached_property
    def covariance(self) -> FloatArray | None:
        """Covariance (12, 12) of the intrinsics; None where the fit states none."""
        if self.geometry.covariance is None:
            return None
        names = self.projection.names
        stated = [name for name in self.geometry.parameters if name in names]
        covariance = np.zeros((len(names), len(names)))
        at = [names.index(name) for name in stated]
        covariance[np.ix_(at, at)] = np.array(self.geometry.covariance)[: len(stated), : len(stated)]
        return covariance

    def _ideal(self, pixels: FloatArray, intrinsics: FloatArray) -> FloatArray:
        """Return where points recorded at `pixels` (n, 2: x, y) would be without distortion, px: a central projection
        of the focal length on the axis."""
        rays = self.projection.unproject(pixels, intrinsics)
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = rays[:, :2] / np.where(rays[:, 2:] > 1e-3, rays[:, 2:], np.nan)
        return np.asarray(plane * intrinsics[:2] + intrinsics[2:4])

    def local(self, pixels: FloatArray, intrinsics: FloatArray) -> FloatArray:
        """Return the local distortion (n,), %, at `pixels` (n, 2)."""
        centre = intrinsics[2:4]
        actual = np.linalg.norm(pixels - centre, axis=1)
        ideal = np.linalg.norm(self._ideal(pixels, intrinsics) - centre, axis=1)
        return 100.0 * (actual - ideal) / ideal

    def _with_std(self, figure: Callable[[FloatArray], float]) -> tuple[float, float | None]:
        """Return a figure of the intrinsics and its standard deviation by their covariance."""
        value = figure(self.intrinsics)
        if not np.isfinite(value):
            raise NotDetermined(self.name, "the frame reaches beyond 90 degrees: no plane chart fills it")
        if self.covariance is None:
            return value, None
        steps = STEP_SIGMA * np.sqrt(np.diag(self.covariance))
        gradient = np.zeros(len(steps))
        for k in np.flatnonzero(steps):
            moved = [self.intrinsics.copy(), self.intrinsics.copy()]
            moved[0][k] += steps[k]
            moved[1][k] -= steps[k]
            gradient[k] = (figure(moved[0]) - figure(moved[1])) / (2.0 * steps[k])
        return value, float(np.sqrt(max(float(gradient @ self.covariance @ gradient), 0.0)))

    def _at(self, share: float) -> Estimate:
        """Return the mean local distortion on four rays to the corners at a share of the half diagonal."""
        camera = self.measured.camera
        middle = np.array([0.5 * (camera.cols - 1), 0.5 * (camera.rows - 1)])
        corners = middle + share * middle * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        value, std = self._with_std(lambda intrinsics: float(self.local(corners, intrinsics).mean()))
        return Estimate(value=value, std=std, unit="%")

    @ClauseFigure
    def local_distortion_half(self) -> Estimate:
        """Return the local geometric distortion at half of the image height.

        Clause: 6.1.1. Symbol: LGD(0.5). Unit: %.
        Formula: 100 (h′ − h) / h, h′ recorded and h ideal distance from the axis, mean over the four diagonals.
        """
        return self._at(0.5)

    @ClauseFigure
    def local_distortion_edge(self) -> Estimate:
        """Return the local geometric distortion at 0.9 of the image height.

        Clause: 6.1.1. Symbol: LGD(0.9). Unit: %.
        Formula: 100 (h′ − h) / h, mean over the four diagonals.
        """
        return self._at(0.9)

    @ClauseFigure
    def largest_local_distortion(self) -> Estimate:
        """Return the largest local geometric distortion.

        Clause: 6.1.1. Symbol: LGD_max. Unit: %.
        Formula: value of largest modulus of 100 (h′ − h) / h over the frame.
        """
        pixels = self._grid(MAP_ROWS, MAP_COLS)
        values = self.local(pixels, self.intrinsics)
        if not np.any(np.isfinite(values)):
            raise NotDetermined(self.name, "the frame reaches beyond 90 degrees: no plane chart fills it")
        at = pixels[[int(np.nanargmax(np.abs(values)))]]
        value, std = self._with_std(lambda intrinsics: float(self.local(at, intrinsics)[0]))
        return Estimate(value=value, std=std, unit="%")

    def _bend(self, intrinsics: FloatArray, axis: int) -> float:
        """Return the bend of the chart's lines at two opposite borders, %, mean: the shift of a line's middle against
        its ends over the frame's size across it, positive outwards. `axis`: 0 of lines along x, 1 along y."""
        camera = self.measured.camera
        size = np.array([camera.cols - 1.0, camera.rows - 1.0])
        readings = []
        for side in (0.0, 1.0):
            ends = np.zeros((2, 2))
            ends[1, axis] = size[axis]
            ends[:, 1 - axis] = side * size[1 - axis]
            ideal = self._ideal(ends, intrinsics)
            # the chart's line at the mean height of both ends
            line = np.empty((LINE_POINTS, 2))
            line[:, axis] = np.linspace(ideal[0, axis], ideal[1, axis], LINE_POINTS)
            line[:, 1 - axis] = ideal[:, 1 - axis].mean()
            plane = (line - intrinsics[2:4]) / intrinsics[:2]
            points = np.column_stack([plane, np.ones(LINE_POINTS)])
            recorded = self.projection.project(points, intrinsics)[:, 1 - axis]
            outwards = 2.0 * side - 1.0
            bend = recorded[LINE_POINTS // 2] - 0.5 * (recorded[0] + recorded[-1])
            readings.append(outwards * bend / size[1 - axis])
        return 100.0 * float(np.mean(readings))

    @ClauseFigure
    def horizontal_line_distortion(self) -> Estimate:
        """Return the line geometric distortion of horizontal lines.

        Clause: 6.2.1. Symbol: D_h. Unit: %.
        Formula: 100 × shift of the middle of the line at the border against its ends over the picture height, positive
        outwards (barrel).
        """
        value, std = self._with_std(lambda intrinsics: self._bend(intrinsics, 0))
        return Estimate(value=value, std=std, unit="%")

    @ClauseFigure
    def vertical_line_distortion(self) -> Estimate:
        """Return the line geometric distortion of vertical lines.

        Clause: 6.2.2. Symbol: D_v. Unit: %.
        Formula: 100 × shift of the middle of the line at the border against its ends over the picture width, positive
        outwards (barrel).
        """
        value, std = self._with_std(lambda intrinsics: self._bend(intrinsics, 1))
        return Estimate(value=value, std=std, unit="%")

    def _grid(self, rows: int, cols: int) -> FloatArray:
        camera = self.measured.camera
        y, x = np.meshgrid(
            np.linspace(0.0, camera.rows - 1.0, rows), np.linspace(0.0, camera.cols - 1.0, cols), indexing="ij"
        )
        # no point on the axis itself, where the ratio isn't defined
        return np.column_stack([x.ravel(), y.ravel()]) + 1e-3

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="5.3",
            quantity="chart",
            found=f"{self.geometry.views or 0} views of a board in several poses",
            limit="one view of dots or lines parallel to the sensor",
            remedy="nothing: the projection fitted to all views predicts that one, with its uncertainty",
        )

    def conditions(self) -> Iterator[str]:
        yield f"projection: {self.geometry.lens_projection}, {len(CAMERA)} + {len(self.geometry.distortion)} parameters"
        yield f"residuals of {self.geometry.rms_px:.3g} px rms"

    def plots(self) -> Iterator[StandardPlot]:
        shares = np.linspace(0.05, 1.0, 20)
        figures = []
        for share in shares:
            try:
                figures.append((float(share), self._at(float(share))))
            except NotDetermined:
                break
        yield StandardPlot(
            title="Local geometric distortion",
            x_label="image height, of the half diagonal",
            y_label="LGD, %",
            curves=(
                PlotCurve(
                    label="mean of the four diagonals",
                    x=tuple(share for share, _ in figures),
                    y=tuple(estimate.value for _, estimate in figures),
                    y_std=tuple(estimate.std or 0.0 for _, estimate in figures),
                    style="points",
                ),
            ),
        )

    def maps(self) -> Iterator[StandardMap]:
        values = self.local(self._grid(MAP_ROWS, MAP_COLS), self.intrinsics).reshape(MAP_ROWS, MAP_COLS)
        yield StandardMap(
            title="Local geometric distortion",
            unit="%",
            values=tuple(tuple(float(v) if np.isfinite(v) else None for v in row) for row in values),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard. Raises NotDetermined where no geometry was fitted."""
    if side.fit.geometry is None:
        raise NotDetermined(Iso17850.name, "no geometry was fitted; capture views of a ChArUco board")
    yield Iso17850(side, side.fit.geometry)
