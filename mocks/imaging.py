"""What the bench's cameras see: mean electrons a second of every pixel, on a finer grid than the fitted model's.

Scenes are flat targets in front of the rig, seen through each camera's homography and lens distortion (so edges are bent as
a real lens bends them). Straight edges are exact slices of `sim.forward.optical_transfer`; everything else is drawn by area
on 3 x 3 or 4 x 4 samples a pixel, which holds all that the lens passes, and multiplied with it in the frequency domain.
What is left of drawing by area (measured against 8 x 8): 0.05 % rms of white on boards, 0.15 % on random screen patterns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from mocks.truth import DISTANCE_MM, HiddenCamera
from sim.forward import edge_profile, electron_rate, optical_transfer
from sim.optics.illumination import relative_illumination, sin_theta
from sim.scene import colorchecker
from sim.scene.render import Grid, cells, quadrilateral
from sim.scene.warp import Warp
from sim.sensor.mosaic import assemble
from sim.spectrum import FloatArray, Spectrum

OVERSAMPLE, SCREEN_OVERSAMPLE, MARGIN_PX = 3, 4, 16
Transfer = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a flat target stands: its point X (mm, z = 0) is at `rotation` X + `centre_mm` in the rig's frame."""

    rotation: FloatArray
    centre_mm: FloatArray

    @classmethod
    def of(cls, centre_mm: tuple[float, float, float], euler_xyz_deg: tuple[float, float, float]) -> Pose:
        """A pose from the place of the target's origin and its turns about its own x, y and z."""
        return cls(Rotation.from_euler("XYZ", euler_xyz_deg, degrees=True).as_matrix(), np.array(centre_mm))

    def warp(self, camera: HiddenCamera, unit_mm: float = 1.0, origin_mm: tuple[float, float] = (0.0, 0.0)) -> Warp:
        """From the target's plane to the camera's px: u, v in units of `unit_mm` from `origin_mm` [x, y]."""
        corner = self.rotation @ np.array([*origin_mm, 0.0]) + self.centre_mm - camera.centre_mm
        plane = np.column_stack([self.rotation[:, 0] * unit_mm, self.rotation[:, 1] * unit_mm, corner])
        return Warp.of(np.asarray(camera.geometry.camera_matrix) @ camera.rotation @ plane, camera.geometry)


#: Upright at the targets' distance.
FACING = Pose.of((0.0, 0.0, DISTANCE_MM), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Edge:
    """One straight edge of a knife-edge target: through `through_mm` [x, y], at `angle_deg` from the vertical (positive turns
    the top to the right), light on the side of larger x; it rules what is nearest to `centre_mm`."""

    centre_mm: tuple[float, float]
    through_mm: tuple[float, float]
    angle_deg: float


def transfer(camera: HiddenCamera, channel: str, radiance: Spectrum, most_cy_per_px: float) -> Transfer:
    """The channel's optical transfer function as a function of ascending fy and fx >= 0 (cy/px) -> (fy.size, fx.size).

    `sim.forward.optical_transfer` on nodes that lie closer near zero frequency, where it has a cusp, then a cubic spline.
    """
    fx = most_cy_per_px * np.linspace(0.0, 1.0, 72) ** 1.6
    fy = np.concatenate([-fx[:0:-1], fx])
    values = np.real(optical_transfer(camera.model, channel, radiance, fx[None, :], fy[:, None], camera.effects))
    # a spline on either side of fy = 0, so that the cusp stays one
    below = RectBivariateSpline(fy[: fx.size], fx, values[: fx.size])
    above = RectBivariateSpline(fx, fx, values[fx.size - 1 :])

    def at(fy_wanted: FloatArray, fx_wanted: FloatArray) -> FloatArray:
        split = int(np.searchsorted(fy_wanted, 0.0))
        return np.concatenate([below(fy_wanted[:split], fx_wanted), above(fy_wanted[split:], fx_wanted)])

    return at


class Imager:
    """Draws and blurs scenes for one camera; keeps what depends on the camera alone.

    Every method returns electrons a second of light, (rows, cols), with the lens's fall-off, without pattern noise.
    """

    def __init__(self, camera: HiddenCamera) -> None:
        self.camera = camera
        model = camera.model
        row, col = np.arange(model.rows)[:, None], np.arange(model.cols)[None, :]
        self._fall_off = relative_illumination(model, row, col)
        self._sine = sin_theta(model, row, col)
        self._transfers: dict[str, FloatArray] = {}
        self._kept_for: tuple[str, int] = ("", 0)

    def rate(self, channel: str, radiance: Spectrum, reflectance: Spectrum | None = None, sine: float = 0.0) -> float:
        """Electrons a second of a pixel on axis (or at a chief ray's `sine`, without the fall-off)."""
        return electron_rate(
            self.camera.model, channel, radiance, self.camera.effects, sin_theta=sine, reflectance=reflectance
        )

    def uniform(self, radiance: Spectrum) -> FloatArray:
        """A uniform field. Filters that depend on the ray's angle are followed at five angles."""
        sines = np.linspace(0.0, float(np.max(self._sine)), 5)
        images = {}
        for channel in self.camera.model.channels:
            rates = [self.rate(channel, radiance, sine=float(sine)) for sine in sines]
            images[channel] = np.interp(self._sine, sines, rates)
        return assemble(images, self.camera.model.cfa) * self._fall_off

    def pattern(
        self,
        cell: FloatArray,
        warp: Warp,
        dark: Spectrum,
        light: Spectrum,
        light_name: str,
        *,
        surround: float = 0.0,
        oversample: int = OVERSAMPLE,
    ) -> FloatArray:
        """Square cells of 0..1 between two spectra, seen through a warp: a screen, or a printed board.

        `light_name` identifies the light's colour.
        """
        grid = self._grid(oversample)
        spectrum = fft.rfft2(cells(cell, warp, grid, surround))
        images = {}
        for channel in self.camera.model.channels:
            low, high = self.rate(channel, dark), self.rate(channel, light)
            blurred = self._blur(spectrum, channel, light, light_name, grid)
            images[channel] = np.maximum(low + (high - low) * blurred, 0.0)
        return assemble(images, self.camera.model.cfa) * self._fall_off

    def edges(self, edges: tuple[Edge, ...], dark: Spectrum, light: Spectrum) -> FloatArray:
        """A target of straight edges, each ruling the part of the plane that is nearest to its centre.

        A pixel sees the edge's profile at its distance; the lens's distortion bends distance and slope along the edge.
        """
        model = self.camera.model
        warp = FACING.warp(self.camera)
        x, y = warp.grid_to_pattern(np.arange(model.rows, dtype=float), np.arange(model.cols, dtype=float))
        owner = np.argmin([np.hypot(x - edge.centre_mm[0], y - edge.centre_mm[1]) for edge in edges], axis=0)
        x_down, x_across = np.gradient(x)
        y_down, y_across = np.gradient(y)
        images = {channel: np.empty_like(x) for channel in model.channels}
        for index, edge in enumerate(edges):
            c, s = np.cos(np.deg2rad(edge.angle_deg)), np.sin(np.deg2rad(edge.angle_deg))
            across, down = x_across * c + y_across * s, x_down * c + y_down * s
            slope = np.hypot(across, down)
            distance_px = ((x - edge.through_mm[0]) * c + (y - edge.through_mm[1]) * s) / slope
            row, col = (int(np.rint(at)) for at in warp.to_camera(*edge.centre_mm))
            angle_deg = float(np.rad2deg(np.arctan2(down[row, col], across[row, col])))
            mine = owner == index
            for channel in model.channels:
                low, high = self.rate(channel, dark), self.rate(channel, light)
                profile = edge_profile(model, channel, light, angle_deg, distance_px[mine], self.camera.effects)
                images[channel][mine] = np.maximum(low + (high - low) * profile, 0.0)
        return assemble(images, model.cfa) * self._fall_off

    def chart(self, warp: Warp, gap: float, radiance: Spectrum, light_name: str) -> FloatArray:
        """A ColorChecker: patch k is at column k % 6, row k // 6 of the warp's plane, 1 - `gap` wide."""
        grid = self._grid(OVERSAMPLE)
        row, col = grid.axes_px()
        reflectances = colorchecker.reflectances()
        windows: list[tuple[slice, slice, FloatArray]] = []
        for index in range(len(reflectances)):
            u, v, size = float(index % 6), float(index // 6), 1.0 - gap
            corner_row, corner_col = warp.to_camera(
                np.array([u, u + size, u + size, u]), np.array([v, v, v + size, v + size])
            )
            rows = slice(*np.searchsorted(row, [corner_row.min() - 1, corner_row.max() + 1]))
            cols = slice(*np.searchsorted(col, [corner_col.min() - 1, corner_col.max() + 1]))
            coverage = quadrilateral(row[rows], col[cols], 1.0 / OVERSAMPLE, corner_row, corner_col)
            windows.append((rows, cols, coverage))
        images = {}
        for channel in self.camera.model.channels:
            frame = self.rate(channel, radiance, colorchecker.FRAME_REFLECTANCE)
            picture = np.full(grid.shape, frame)
            for reflectance, (rows, cols, coverage) in zip(reflectances.values(), windows, strict=True):
                picture[rows, cols] += (self.rate(channel, radiance, reflectance) - frame) * coverage
            images[channel] = np.maximum(self._blur(fft.rfft2(picture), channel, radiance, light_name, grid), 0.0)
        return assemble(images, self.camera.model.cfa) * self._fall_off

    def _grid(self, oversample: int) -> Grid:
        return Grid(self.camera.model.rows, self.camera.model.cols, oversample, MARGIN_PX)

    def _blur(self, spectrum: FloatArray, channel: str, radiance: Spectrum, light_name: str, grid: Grid) -> FloatArray:
        """The fine picture with Fourier transform `spectrum`, blurred and taken at the pixels' centres."""
        (rows, cols), fine = grid.shape, grid.oversample
        if self._kept_for != (light_name, fine):  # one light's are kept: they are large
            self._transfers.clear()
            self._kept_for = (light_name, fine)
        if channel not in self._transfers:
            self._transfers[channel] = self._kernel(channel, radiance, grid)
        product = spectrum * self._transfers[channel]
        # keep one sample in `fine`: along rows before the transform (folding), along columns after it
        folded = product.reshape(fine, rows // fine, -1).sum(0) / fine
        image = np.asarray(fft.irfft(fft.ifft(folded, axis=0), cols, axis=1))[:, ::fine]
        return image[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]

    def _kernel(self, channel: str, radiance: Spectrum, grid: Grid) -> FloatArray:
        """What a drawn picture's transform is multiplied with: the channel's transfer function over that of the drawing's
        squares, moved so that the first of every pixel's samples is its centre."""
        (rows, cols), fine = grid.shape, grid.oversample
        fy = fft.fftfreq(rows, 1.0 / fine)
        fx = fft.rfftfreq(cols, 1.0 / fine)
        order = np.argsort(fy)
        value = np.empty((rows, fx.size))
        value[order] = transfer(self.camera, channel, radiance, fine / 2)(fy[order], fx)
        move = 0.5 * (fine - 1) / fine
        return np.asarray(
            value
            * (np.exp(2j * np.pi * move * fy) / np.sinc(fy / fine))[:, None]
            * (np.exp(2j * np.pi * move * fx) / np.sinc(fx / fine))[None, :],
            np.complex64,
        )


def corners_px(warp: Warp, width: float, height: float) -> FloatArray:
    """[row, col] of the corners (0, 0), (width, 0), (width, height), (0, height) of a target's plane."""
    row, col = warp.to_camera(np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height]))
    return np.stack([row, col], axis=1)
