"""The optical transfer function of an aberrated lens with a circular pupil, by autocorrelation of the pupil: no FFT, no
sampling of the pupil, any frequency."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.spectrum import FloatArray

#: Path error in um at points (x, y) of the pupil of radius 1, x along columns, y along rows.
Wavefront = Callable[[FloatArray, FloatArray], FloatArray]


def seidel(
    *,
    defocus_um: float = 0.0,
    spherical_um: float = 0.0,
    coma_um: tuple[float, float] = (0.0, 0.0),
    astigmatism_um: float = 0.0,
    astigmatism_deg: float = 0.0,
) -> Wavefront:
    """W(x, y) = W020 r^2 + W040 r^4 + r^2 (W131x x + W131y y) + W222 u^2, u along `astigmatism_deg` from x; um at the rim.

    W020 = dz / (8 N^2) for a sensor that is dz away from the focus.
    """
    angle = np.deg2rad(astigmatism_deg)

    def wavefront(x: FloatArray, y: FloatArray) -> FloatArray:
        r2 = x * x + y * y
        u = x * np.cos(angle) + y * np.sin(angle)
        return r2 * (defocus_um + spherical_um * r2 + coma_um[0] * x + coma_um[1] * y) + astigmatism_um * u * u

    return wavefront


def pupil_otf(
    fx_cy_per_um: ArrayLike,
    fy_cy_per_um: ArrayLike,
    wavelength_nm: float,
    f_number: float,
    wavefront: Wavefront,
    *,
    nodes: int | None = None,
) -> NDArray[np.complex128]:
    """OTF of a circular pupil with path error `wavefront`, complex, of the broadcast shape of the frequencies; 0 beyond the cutoff.

    H(f) = (1 / pi) integral over the overlap of two unit discs of exp(-2 pi i [W(p + s/2) - W(p - s/2)] / wavelength), with
    s = 2 wavelength f_number f, so that W = a x moves the image by 2 f_number a along +x. (Hopkins 1955; Goodman,
    Introduction to Fourier Optics.) The lens-shaped overlap is laid out in coordinates in which the integrand is smooth, and
    Gauss-Legendre nodes (`nodes` each way and half) are taken as the path differences ask for: to 1e-6 below 20 waves.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_um, float), np.asarray(fy_cy_per_um, float))
    wavelength_um = wavelength_nm * 1e-3
    share = np.hypot(fx, fy).ravel() * (
        wavelength_um * f_number
    )  # of the cutoff: half the distance of the discs' centres
    out = np.zeros(share.size, complex)
    inside = np.flatnonzero(share < 1.0)
    if nodes is None:
        nodes = _nodes_for(wavefront, wavelength_um)
    t, weight = np.polynomial.legendre.leggauss(nodes)
    angle = np.arctan2(fy, fx).ravel()
    block = max(1, 2_000_000 // (2 * nodes * nodes))
    for start in range(0, inside.size, block):
        at = inside[start : start + block]
        c = share[at][:, None, None]
        # Points (u, v) of one half of the overlap, u along the frequency: u + c = cos(theta), |v| <= sin(theta), so that
        # dA = sin^2(theta) d(theta) d(eta); the other half is its mirror image in u.
        limit = np.arccos(c)
        theta = 0.5 * limit * (1.0 + t[None, :, None])
        sine = np.sin(theta)
        u, v = np.cos(theta) - c, sine * t[None, None, :]
        area = 0.5 * limit * weight[None, :, None] * weight[None, None, :] * sine * sine / np.pi
        ca, sa = np.cos(angle[at])[:, None, None], np.sin(angle[at])[:, None, None]
        total = np.zeros(at.size, complex)
        for half in (u, -u):
            far = wavefront((half + c) * ca - v * sa, (half + c) * sa + v * ca)
            near = wavefront((half - c) * ca - v * sa, (half - c) * sa + v * ca)
            total += np.sum(area * np.exp((-2j * np.pi / wavelength_um) * (far - near)), axis=(1, 2))
        out[at] = total
    return out.reshape(fx.shape)


def _nodes_for(wavefront: Wavefront, wavelength_um: float) -> int:
    """Gauss-Legendre needs about half a node a radian of phase, and a few."""
    x = np.linspace(-1.0, 1.0, 41)
    xs, ys = np.meshgrid(x, x)
    pupil = np.hypot(xs, ys) <= 1.0
    path = wavefront(xs[pupil], ys[pupil])
    waves = float(np.ptp(path)) / wavelength_um
    return int(min(16 + 7.0 * waves, 200))
