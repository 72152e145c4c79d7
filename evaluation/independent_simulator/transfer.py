"""Lens, silicon and pixel aperture as transfer functions, and images filtered by them.

Spectra are integrated at 1 nm, the overlap of the pupils by Gauss-Legendre quadrature.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from evaluation.independent_simulator.law import WAVELENGTH_NM, Array, CameraProperties

NODES_NM = np.arange(384.0, 781.0, 9.0)  # at which transfer functions are formed
QUADRATURE = np.polynomial.legendre.leggauss(20)
HIGHEST_CY_PX = 3.2  # of the tables; the lens transmits nothing beyond


class Transfer:
    """Transfer functions of one camera."""

    def __init__(self, camera: CameraProperties) -> None:
        self.camera = camera
        self._tables: dict[float, Array] = {}

    def otf(self, frequency_cy_px: Array, angle_rad: float, radiance: Array, channel: str) -> Array:
        """Optical transfer function along a direction (from x) in light of `radiance`; complex where the image isn't
        symmetric."""
        f = np.asarray(frequency_cy_px) / self.camera.pitch_um
        return (self._weights(radiance, channel) @ self._spectral(frequency_cy_px, angle_rad)) * self._achromatic(
            f * np.cos(angle_rad), f * np.sin(angle_rad)
        )

    def diffraction(self, frequency_cy_um: Array, wavelength_um: float) -> Array:
        """Overlap of two discs: the transfer function of a perfect lens."""
        s = np.clip(np.abs(frequency_cy_um) * wavelength_um * self.camera.working_f_number, 0, 1)
        return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))

    def filtered(self, images: dict[str, Array], radiance: Array, over: int) -> dict[str, Array]:
        """Images on a grid `over` times finer than the pixels, filtered by the OTF, at the pixels' centres. The borders
        are continued."""
        out: dict[str, Array] = {}
        table_f = np.linspace(0, 2.9, 881)  # linear interpolation errs by 1e-5
        table_angle = np.linspace(-np.pi / 2, np.pi / 2, 25 if self._aberrated else 2)
        pad = 24 * over
        spectra: dict[int, Array] = {}
        for channel, image in images.items():
            if id(image) not in spectra:
                spectra[id(image)] = np.fft.rfft2(np.pad(image, pad, mode="edge"))
            shape = (image.shape[0] + 2 * pad, image.shape[1] + 2 * pad)
            fy, fx = np.fft.fftfreq(shape[0], 1 / over)[:, None], np.fft.rfftfreq(shape[1], 1 / over)[None, :]
            radius = np.minimum(np.hypot(fx, fy), 2.9)
            weights = self._weights(radiance, channel)
            table = np.array([weights @ self._spectral(table_f, a) for a in table_angle])
            h = (
                RegularGridInterpolator((table_angle, table_f), table)((np.arctan2(fy, fx), radius))
                if self._aberrated
                else np.interp(radius, table_f, table[0])
            )
            h = h * self._achromatic(fx / self.camera.pitch_um, fy / self.camera.pitch_um)
            if over > 1:
                h = h / (np.sinc(fx / over) * np.sinc(fy / over))  # each sample is a mean over its own square
            # samples lie at (k + 0.5) / over - 0.5: the phase moves them to the pixels' centres
            phase = np.exp(2j * np.pi * (fx + fy) * (0.5 - 0.5 / over))
            out[channel] = np.fft.irfft2(spectra[id(image)] * h * phase, shape)[
                pad : shape[0] - pad : over, pad : shape[1] - pad : over
            ]
        return out

    @cached_property
    def shifts_image(self) -> bool:
        """Whether a law moves the image."""
        return any(law.image_shift_px(np.zeros(1), np.zeros(1), 550.0) is not None for law in self.camera.laws)

    def unshifted(self, row: Array, col: Array, channel: str, radiance: Array) -> tuple[Array, Array]:
        """Return where (px) the light that arrives at a position would arrive without the laws' shifts, averaged over
        the detected spectrum."""
        if not self.shifts_image:
            return row, col
        camera = self.camera
        weights = self._weights(radiance, channel)
        half = camera.half_diagonal_px
        from_row, from_col = np.broadcast_arrays(row, col)
        for _ in range(2):  # fixed-point iteration: the shifts are small
            x, y = (from_col - (camera.cols - 1) / 2) / half, (from_row - (camera.rows - 1) / 2) / half
            right, down = np.zeros(x.shape), np.zeros(x.shape)
            for law in camera.laws:
                for weight, wavelength in zip(weights, NODES_NM, strict=True):
                    shift = law.image_shift_px(x, y, float(wavelength)) if abs(weight) > 1e-6 else None
                    if shift is not None:
                        right, down = right + weight * shift[0], down + weight * shift[1]
            from_row, from_col = row - down, col - right
        return from_row, from_col

    @cached_property
    def _aberrated(self) -> bool:
        return any(law.path_error_um(np.zeros(1), np.zeros(1), 550.0) is not None for law in self.camera.laws)

    def _pupil(self, frequency_cy_um: Array, angle_rad: float, wavelength_nm: float) -> Array:
        """Autocorrelation of the aberrated pupil along a direction, complex; 20 x 20 nodes in the overlap."""
        node, weight = QUADRATURE
        # half the separation of the two pupils, in their radii
        s = np.clip(frequency_cy_um * wavelength_nm / 1000 * self.camera.working_f_number, 0, 1)[:, None, None]
        top = np.sqrt(np.clip(1 - s * s, 0, None))
        v = top * node[None, :, None]
        reach = np.sqrt(np.clip(1 - v * v, 0, None)) - s
        u = reach * node[None, None, :]
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        path = np.zeros(np.broadcast_shapes(u.shape, v.shape))
        for law in self.camera.laws:
            ahead = law.path_error_um((u + s) * cos - v * sin, (u + s) * sin + v * cos, wavelength_nm)
            if ahead is not None:
                path = path + ahead - law.path_error_um((u - s) * cos - v * sin, (u - s) * sin + v * cos, wavelength_nm)
        part = top * np.clip(reach, 0, None) * weight[None, :, None] * weight[None, None, :]
        return (part * np.exp(2j * np.pi * path / (wavelength_nm / 1000))).sum((1, 2)) / np.pi

    def _spectral(self, frequency_cy_px: Array, angle_rad: float) -> Array:
        """(NODES_NM, frequency): what depends on the wavelength, lens and silicon."""
        f = np.asarray(frequency_cy_px) / self.camera.pitch_um
        if not self._aberrated:
            table = np.array([self.diffraction(f, w / 1000) for w in NODES_NM])
        else:
            key = round(angle_rad, 9)
            coarse = np.linspace(0, HIGHEST_CY_PX, 81)
            if key not in self._tables:
                whole = np.array([self._pupil(coarse / self.camera.pitch_um, angle_rad, w) for w in NODES_NM])
                self._tables[key] = whole / whole[:, :1]  # the quadrature's area is good to 1e-4
            table = CubicSpline(coarse, self._tables[key], axis=1)(np.minimum(frequency_cy_px, HIGHEST_CY_PX))
        for law in self.camera.laws:
            table = table * np.array([law.spectral_transfer(f, w / 1000) * np.ones_like(f) for w in NODES_NM])
        return table

    def _weights(self, radiance: Array, channel: str) -> Array:
        """Share of the detected photons at each of NODES_NM."""
        camera = self.camera
        detected = radiance * WAVELENGTH_NM * camera.quantum_efficiency[channel] * camera.filter_transmittance[channel]
        at = np.clip((WAVELENGTH_NM - NODES_NM[0]) / (NODES_NM[1] - NODES_NM[0]), 0, len(NODES_NM) - 1)
        left = np.minimum(at.astype(int), len(NODES_NM) - 2)
        weights = np.bincount(left, detected * (1 - at + left), len(NODES_NM)) + np.bincount(
            left + 1, detected * (at - left), len(NODES_NM)
        )
        return weights / weights.sum()

    def _achromatic(self, fx_cy_um: Array, fy_cy_um: Array) -> Array:
        """Return what doesn't depend on the wavelength: the pixel's aperture and laws."""
        side_um = np.sqrt(self.camera.fill_factor) * self.camera.pitch_um
        laws = self.camera.laws
        own = next(
            (h for h in (law.aperture_transfer(fx_cy_um, fy_cy_um, side_um) for law in laws) if h is not None), None
        )
        out = np.sinc(side_um * fx_cy_um) * np.sinc(side_um * fy_cy_um) if own is None else own
        for law in laws:
            out = out * law.transfer(fx_cy_um, fy_cy_um)
        return out
