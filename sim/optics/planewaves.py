"""Point spread function and transfer function of traced rays: every ray is a plane wave at the image.

U(x, y) = sum_j w_j exp(i k [OPL_j + L_j (x - x_j) + M_j (y - y_j)]), w_j = sqrt(J_j K_j) dA_j, with
J = d(L, M)/d(pupil) at the image and K the light that a unit of the pupil's area takes in; k = 2 pi n / wavelength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from sim.spectrum import FloatArray

ComplexArray = NDArray[np.complex128]

#: Orders that are tried for a fitted wave, and the residual (waves, rms) at which one is good enough.
_ORDERS = (10, 14, 18)
_WAVE_RESIDUAL = 2e-3


@dataclass(frozen=True)
class PupilRays:
    """The rays of one field point and wavelength at the image plane, with their shares in the pupil.

    `x_mm`, `y_mm` are where a ray meets the image plane, `cosine_x`, `cosine_y` its direction there, `path_mm` its
    optical path, `area` the light that the ray stands for (K dA) and `jacobian` J / K, d(L, M) by that light.
    `mirrored` says that a ray at +x stands for its mirror image too (`area` is that of one of them). `rim_cosine_x`,
    `rim_cosine_y` trace the pupil's rim in direction cosines, closed, once around.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    cosine_x: FloatArray
    cosine_y: FloatArray
    path_mm: FloatArray
    jacobian: FloatArray
    area: FloatArray
    rim_cosine_x: FloatArray
    rim_cosine_y: FloatArray
    mirrored: bool
    wavelength_nm: float
    index: float

    @property
    def energy(self) -> float:
        """Light that leaves the lens: integral K dA."""
        return float(np.sum(self.area)) * (2.0 if self.mirrored else 1.0)

    @property
    def solid_angle(self) -> float:
        """Integral dL dM over the open pupil."""
        return float(np.sum(self.area * self.jacobian)) * (2.0 if self.mirrored else 1.0)

    @property
    def centroid_mm(self) -> tuple[float, float]:
        """Centroid (x, y) of the light on the image plane: that of the rays, which is that of the wave too."""
        total = np.sum(self.area)
        x = 0.0 if self.mirrored else float(np.sum(self.area * self.x_mm) / total)
        return x, float(np.sum(self.area * self.y_mm) / total)

    @property
    def wave_number_per_mm(self) -> float:
        """k = 2 pi n / wavelength."""
        return 2.0 * np.pi * self.index / (self.wavelength_nm * 1e-6)

    def plane_path_mm(self, x_mm: float, y_mm: float) -> FloatArray:
        """Path of every ray's plane wave at the image point (x, y): OPL + n (L (x - x_j) + M (y - y_j))."""
        return self.path_mm + self.index * (self.cosine_x * (x_mm - self.x_mm) + self.cosine_y * (y_mm - self.y_mm))


def interpolate_rays(
    traced: Sequence[PupilRays], wavelength_nm: Sequence[float] | FloatArray, index: Sequence[float]
) -> list[PupilRays]:
    """Return the rays at wavelengths that weren't traced, at the same relative positions in the open pupil.

    Lagrange's polynomial through all of `traced` in 1 / wavelength^2; a traced wavelength returns its own rays.
    """
    names = ("x_mm", "y_mm", "cosine_x", "cosine_y", "path_mm", "jacobian", "area", "rim_cosine_x", "rim_cosine_y")
    nodes = np.array([rays.wavelength_nm for rays in traced]) ** -2.0
    stacks = {name: np.stack([getattr(rays, name) for rays in traced]) for name in names}
    out = []
    for w, n in zip(wavelength_nm, index, strict=True):
        share = np.array([np.prod([(w**-2.0 - b) / (a - b) for b in nodes if b != a]) for a in nodes])
        values = {name: share @ stack for name, stack in stacks.items()}
        out.append(PupilRays(**values, mirrored=traced[0].mirrored, wavelength_nm=float(w), index=float(n)))
    return out


@njit(cache=True)  # type: ignore[untyped-decorator]
def _waves(phase: Any, step: Any, weight: Any, count: int) -> Any:
    """(2, count, rays): real and imaginary part of weight exp(i (phase + step m)), m = 0, 1, ..., by recurrence."""
    out = np.empty((2, count, phase.size))
    for j in range(phase.size):
        re, im = weight[j] * np.cos(phase[j]), weight[j] * np.sin(phase[j])
        cs, sn = np.cos(step[j]), np.sin(step[j])
        for i in range(count):
            out[0, i, j], out[1, i, j] = re, im
            re, im = re * cs - im * sn, re * sn + im * cs
    return out


def point_spread(
    rays: PupilRays, centre_mm: tuple[float, float], samples: int, pitch_um: float, reach_mm: float = np.inf
) -> FloatArray:
    """(samples, samples) intensities on points around `centre_mm`, rows along y, as shares of all that leaves the lens.

    Parseval: sum of |U|^2 dx dy over the whole plane is (wavelength / n)^2 times the light in the pupil. Rays that meet
    the image farther than `reach_mm` from the centre are left out, smoothly over the outer third of that distance: they
    send no light into a window that lies well within, and the others need fewer rays to be summed right.
    """
    k, pitch = rays.wave_number_per_mm, pitch_um * 1e-3
    first = -0.5 * (samples - 1) * pitch
    weight = np.sqrt(np.abs(rays.jacobian)) * rays.area
    if np.isfinite(reach_mm):
        away = np.hypot(rays.x_mm - centre_mm[0], rays.y_mm - centre_mm[1]) / reach_mm
        weight = weight * np.cos(0.5 * np.pi * np.clip(3.0 * away - 2.0, 0.0, 1.0)) ** 2
    path = rays.plane_path_mm(*centre_mm) / rays.index
    path = path - np.mean(path)
    rows = _waves(k * (path + rays.cosine_y * first), k * rays.cosine_y * pitch, weight, samples)
    if rays.mirrored and centre_mm[0] == 0.0:
        # exp(i k L x) + exp(-i k L x) = 2 cos(k L x), and the window is its own mirror image.
        half = (samples + 1) // 2
        columns = _waves(k * rays.cosine_x * first, k * rays.cosine_x * pitch, np.full(rays.cosine_x.size, 2.0), half)[
            0
        ]
        intensity = (rows[0] @ columns.T) ** 2 + (rows[1] @ columns.T) ** 2
        intensity = np.concatenate([intensity, intensity[:, : samples - half][:, ::-1]], axis=1)
    else:
        ones = np.ones(rays.cosine_x.size)
        columns = _waves(k * rays.cosine_x * first, k * rays.cosine_x * pitch, ones, samples)
        wave = (rows[0] + 1j * rows[1]) @ (columns[0] + 1j * columns[1]).T
        intensity = wave.real**2 + wave.imag**2
    scale = (rays.wavelength_nm * 1e-6 / rays.index) ** 2 * rays.energy
    return np.asarray(intensity * (pitch * pitch / scale))


def _terms(x: FloatArray, y: FloatArray, order: int) -> FloatArray:
    """(points, terms): products of Chebyshev polynomials T_i(x) T_j(y) with i + j <= order."""
    tx = np.polynomial.chebyshev.chebvander(x, order)
    ty = np.polynomial.chebyshev.chebvander(y, order)
    return np.stack([tx[..., i] * ty[..., j] for i in range(order + 1) for j in range(order + 1 - i)], axis=-1)


def _dense(closed: FloatArray, factor: int = 8) -> FloatArray:
    """Return a closed curve's coordinate at `factor` times as many points, by a periodic cubic spline."""
    count = closed.size
    spline = CubicSpline(np.arange(count + 1), np.append(closed, closed[0]), bc_type="periodic")
    return np.asarray(spline(np.arange(count * factor) / factor))


def _chords(rim_along: FloatArray, rim_across: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where lines at `across` enter and leave the rim's polygon: its lower and upper end along the other
    axis."""
    a0, c0 = rim_along, rim_across
    a1, c1 = np.roll(a0, -1), np.roll(c0, -1)
    line = across[:, None]
    cut = (c0 <= line) != (c1 <= line)
    share = (line - c0) / np.where(cut, c1 - c0, 1.0)
    along = a0 + (a1 - a0) * share
    return np.where(cut, along, np.inf).min(axis=1), np.where(cut, along, -np.inf).max(axis=1)


def transfer(
    rays: PupilRays, frequency_lp_per_mm: ArrayLike, origin_mm: tuple[float, float]
) -> tuple[ComplexArray, ComplexArray]:
    """Complex OTF along x (sagittal) and along y (tangential) of an image about `origin_mm`; 1 at frequency 0.

    Autocorrelation of the pupil in direction cosines: H(f) = integral A(s + a/2) A*(s - a/2) ds / integral |A|^2 ds,
    |a| = f wavelength / n, A = sqrt(K / J) exp(2 pi i W / wavelength). W and sqrt(K / J) are Chebyshev sums fitted to
    the rays; the overlap of the pupil with its shifted self is laid out by Gauss-Legendre nodes between its chords: no
    window cuts anything off. Good where lines along the frequency cut the rim twice, which convex pupils grant."""
    wave = _FittedWave.of(rays, origin_mm)
    frequency = np.atleast_1d(np.asarray(frequency_lp_per_mm, float))
    return wave.transfer(frequency, False), wave.transfer(frequency, True)


@dataclass(frozen=True)
class _FittedWave:
    """Path (mm) and amplitude over the pupil's direction cosines as Chebyshev sums."""

    rays: PupilRays
    centre: FloatArray
    half: FloatArray
    order: int
    coefficients: FloatArray  # (2: path and amplitude, order + 1 in x, order + 1 in y)
    nodes: int

    @classmethod
    def of(cls, rays: PupilRays, origin_mm: tuple[float, float]) -> _FittedWave:
        x, y, path = rays.cosine_x, rays.cosine_y, rays.plane_path_mm(*origin_mm)
        amplitude = 1.0 / np.sqrt(np.abs(rays.jacobian))
        if rays.mirrored:
            across = rays.index * rays.cosine_x * origin_mm[0]
            x, y = np.concatenate([x, -x]), np.concatenate([y, y])
            path, amplitude = np.concatenate([path, path - 2.0 * across]), np.concatenate([amplitude, amplitude])
        low = np.array([rays.rim_cosine_x.min(), rays.rim_cosine_y.min()])
        high = np.array([rays.rim_cosine_x.max(), rays.rim_cosine_y.max()])
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        path = path - np.mean(path)
        wavelength_mm = rays.wavelength_nm * 1e-6
        nodes = int(min(56 + 2.0 * np.ptp(path) / wavelength_mm, 200))
        for order in _ORDERS:
            terms = _terms((x - centre[0]) / half[0], (y - centre[1]) / half[1], order)
            q, r = np.linalg.qr(terms)
            coefficients = np.linalg.solve(r, q.T @ np.stack([path, amplitude], axis=1))
            left = float(np.sqrt(np.mean((terms @ coefficients[:, 0] - path) ** 2)))
            if left < _WAVE_RESIDUAL * wavelength_mm:
                break
        place = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
        matrices = np.zeros((2, order + 1, order + 1))
        for (i, j), column in zip(place, coefficients, strict=True):
            matrices[:, i, j] = column
        return cls(rays, centre, half, order, matrices, nodes)

    def transfer(self, frequency_lp_per_mm: FloatArray, tangential: bool) -> ComplexArray:
        rays = self.rays
        rim_along, rim_across = _dense(rays.rim_cosine_x), _dense(rays.rim_cosine_y)
        if tangential:
            rim_along, rim_across = rim_across, rim_along
        t, weight = np.polynomial.legendre.leggauss(self.nodes)
        everywhere = np.linspace(rim_across.min(), rim_across.max(), 402)[1:-1]
        low, high = _chords(rim_along, rim_across, everywhere)
        chord = np.nan_to_num(high - low, posinf=0.0, neginf=0.0)

        def wave(along: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
            c = np.broadcast_to(across[:, None], along.shape)
            x, y = (c, along) if tangential else (along, c)
            tx = np.polynomial.chebyshev.chebvander((x - self.centre[0]) / self.half[0], self.order)
            ty = np.polynomial.chebyshev.chebvander((y - self.centre[1]) / self.half[1], self.order)
            path, amplitude = (np.sum((tx @ matrix) * ty, axis=-1) for matrix in self.coefficients)
            return path, amplitude

        def overlap(shift: float) -> complex:
            inside = np.flatnonzero(chord > shift)
            if inside.size == 0:
                return 0.0j
            # Where the pupil and its shifted self part, between two of the lines: the chord is as long as the shift.
            ends = []
            for k, step in ((inside[0], -1), (inside[-1], 1)):
                beyond = k + step
                if not 0 <= beyond < chord.size:
                    ends.append(rim_across.min() if step < 0 else rim_across.max())
                    continue
                share = (chord[k] - shift) / (chord[k] - chord[beyond])
                ends.append(everywhere[k] + share * (everywhere[beyond] - everywhere[k]))
            # Lines in equal steps of the arc sine: the square-root ends of the chords cost no accuracy.
            theta, reach = 0.5 * np.pi * t, 0.5 * (ends[1] - ends[0])
            across = 0.5 * (ends[0] + ends[1]) + reach * np.sin(theta)
            line_weight = weight * 0.5 * np.pi * reach * np.cos(theta)
            start, end = _chords(rim_along, rim_across, across)
            length = np.maximum(np.nan_to_num(end - start, posinf=0.0, neginf=0.0) - shift, 0.0)
            middle = np.where(length > 0, 0.5 * (start + end), 0.0)
            along = middle[:, None] + 0.5 * length[:, None] * t
            path_far, amplitude_far = wave(along + 0.5 * shift, across)
            path_near, amplitude_near = wave(along - 0.5 * shift, across)
            phase = 2e6 * np.pi / rays.wavelength_nm * (path_far - path_near)
            value = amplitude_far * amplitude_near * np.exp(1j * phase)
            return complex(np.sum(line_weight * 0.5 * length * (value @ weight)))

        whole = overlap(0.0)
        step = rays.wavelength_nm * 1e-6 / rays.index
        return np.array([overlap(float(f) * step) / whole for f in frequency_lp_per_mm])
