"""A camera of another make than `sim`'s, with concealed laws built in, and its raw frames.

Poisson numbers are drawn by inversion of one normal number a pixel, so that a camera with a law and the same camera
without it make the same
noise: the difference of two recordings is the law's alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from evaluation.independent_simulator.law import BIT_DEPTH, WAVELENGTH_NM, Array, FrameTaken, Law
from evaluation.independent_simulator.transfer import Transfer

HC_J_NM = 1.98644586e-16
NORMAL_FROM_E = 60.0  # above, the skewed normal approximates a Poisson number to 1e-3 of its standard deviation
STEP_S = 20.0  # from one capture to the next
DRAW_STEP = 100_000  # more than a session's frames: another draw of the noise has other numbers throughout


class ConcealedCamera:
    """One camera: its parameters are drawn from `seed`, its laws are built in.

    cfa, f_number       None: drawn, too
    noise_draw          selects one of the noises that the same camera can make; its fixed patterns stay
    side                "left" or "right" of a pair
    offset_mm           distance to the right of the pair's left camera
    pair_middle_mm      where boards stand that both cameras see
    bit_depth           of the converter; a code of another depth than 12 has as much more or less charge, so that the
    full well stays
    amplification       of the signal before the converter, which then holds less charge
    stated_f_number     at which path errors of laws are stated; None: f_number. A lens that is stopped down keeps its
    glass: its path errors follow the pupil
    distance_mm         of the scene; None: so far that the image lies in the focal plane
    """

    def __init__(
        self, seed: int, laws: Sequence[Law] = (), *, cfa: str | None = None, f_number: float | None = None,
        rows: int = 384, cols: int = 512, noise_draw: int = 0,
        side: str = "left", offset_mm: float = 0.0, pair_middle_mm: float = 0.0, bit_depth: int = BIT_DEPTH,
        amplification: float = 1.0, distance_mm: float | None = None, stated_f_number: float | None = None,
    ) -> None:  # fmt: skip
        self.side, self.offset_mm, self.pair_middle_mm = side, offset_mm, pair_middle_mm
        self.seed, self.noise_draw, self.rows, self.cols = seed, noise_draw, rows, cols
        rng = np.random.default_rng([seed, 1])
        drawn_cfa = str(rng.choice(["RGGB", "BGGR", "GRBG", "GBRG", "MONO"], p=[0.2, 0.2, 0.2, 0.2, 0.2]))
        self.cfa = cfa or drawn_cfa
        self.pitch_um = float(rng.choice([2.2, 2.8, 3.0, 3.45, 3.75, 4.5]))
        self.fill_factor = float(rng.uniform(0.5, 1.0))
        drawn_f_number = float(rng.choice([2.0, 2.8, 4.0, 5.6]))
        self.f_number = f_number or drawn_f_number
        #: Radius of the open pupil over that for which path errors of laws are stated.
        self.open_pupil = (stated_f_number or self.f_number) / self.f_number
        self.focal_length_mm = float(rng.choice([6.0, 8.0, 12.0]))
        magnification = 0.0 if distance_mm is None else self.focal_length_mm / (distance_mm - self.focal_length_mm)
        #: Image distance over the aperture: of a near scene the image lies behind the focal plane.
        self.working_f_number = self.f_number * (1.0 + magnification)
        self.lens_transmittance = float(rng.uniform(0.85, 0.95))
        self.bit_depth = bit_depth
        self.full_code_dn = 2**bit_depth - 1
        codes = 2.0 ** (bit_depth - BIT_DEPTH)
        self.gain_dn_per_e = amplification * codes * float(rng.uniform(0.3, 0.6))
        self.read_noise_e = float(rng.uniform(1.5, 5.0))
        self.dark_e_per_s = float(rng.uniform(2.0, 20.0))
        self.dsnu_e = float(rng.uniform(0.5, 1.5))
        self.prnu_percent = float(rng.uniform(0.4, 1.0))
        self.black_level_dn = codes * float(rng.choice([64.0, 128.0, 168.0, 240.0]))
        self.full_well_e = (self.full_code_dn - self.black_level_dn) / self.gain_dn_per_e
        peaks = (
            {"Y": (540, 95, 0.62)}
            if self.cfa == "MONO"
            else {"R": (605, 38, 0.5), "G": (530, 42, 0.52), "B": (455, 30, 0.48)}
        )
        cut = 1.0 / (1.0 + np.exp((WAVELENGTH_NM - 705.0) / 8.0))
        scale, tilt = 1 + 0.02 * rng.standard_normal(), 0.015 * rng.standard_normal()
        #: Quantum efficiency by channel at WAVELENGTH_NM: as the maker states it, and the camera's own.
        self.stated_efficiency: dict[str, Array] = {}
        self.quantum_efficiency: dict[str, Array] = {}
        for c, (peak, width, top) in peaks.items():
            mu, sd = peak + rng.uniform(-8, 8), width * rng.uniform(0.9, 1.1)
            curve = (top * np.exp(-0.5 * ((WAVELENGTH_NM - mu) / sd) ** 2) + 0.02 * cut) * cut
            self.stated_efficiency[c] = curve
            self.quantum_efficiency[c] = curve * (
                scale + 0.003 * rng.standard_normal() + tilt * (WAVELENGTH_NM - 560.0) / 160.0
            )
        self.prnu_map = 1 + self.prnu_percent / 100 * rng.standard_normal((rows, cols))
        self.dsnu_map_e = self.dsnu_e * rng.standard_normal((rows, cols))
        r, c = np.mgrid[:rows, :cols]
        half = self.half_diagonal_px
        #: (x, y) of the pixels in half diagonals from the centre.
        self.field_position = (c - (cols - 1) / 2) / half, (r - (rows - 1) / 2) / half
        radius_mm = np.hypot(*self.field_position) * half * self.pitch_um / 1000
        self.laws = tuple(laws)
        for law in self.laws:
            law.bind(self)
        #: Signal of the pixels relative to the axis: natural fall-off and laws.
        self.shading = np.cos(np.arctan(radius_mm / self.focal_length_mm)) ** 4
        for law in self.laws:
            self.shading = self.shading * law.relative_response(*self.field_position)
        one = np.ones_like(WAVELENGTH_NM)
        self.filter_transmittance = {
            c: np.prod([one, *(law.transmittance(c) * one for law in self.laws)], axis=0)
            for c in self.quantum_efficiency
        }
        lens_rng = np.random.default_rng([seed, 5])
        #: Focal length and principal point in px, radial distortion k1 and k2.
        self.focal_length_px = 1000 * self.focal_length_mm / self.pitch_um * float(lens_rng.uniform(0.99, 1.01))
        self.principal_point_px = (
            (cols - 1) / 2 + float(lens_rng.uniform(-3, 3)),
            (rows - 1) / 2 + float(lens_rng.uniform(-3, 3)),
        )
        self.distortion = float(lens_rng.uniform(-0.3, 0.1)), float(lens_rng.uniform(-0.1, 0.1))
        self._previous_e: Array | None = None

    @property
    def half_diagonal_px(self) -> float:
        """From the frame's centre to its corner."""
        return 0.5 * float(np.hypot(self.rows, self.cols))

    @cached_property
    def lens(self) -> Transfer:
        """Lens, silicon and pixel aperture as transfer functions."""
        return Transfer(self)

    def rate(self, radiance: Array, channel: str, kind: str = "flat") -> float:
        """Electrons a second on axis: pi L tau / (4 N^2 + 1) over the pixel's area, by quantum efficiency."""
        for law in self.laws:
            radiance = law.radiance(radiance, kind)
        photons = radiance * WAVELENGTH_NM / HC_J_NM
        irradiance = np.pi / (4 * self.working_f_number**2 + 1) * self.lens_transmittance * photons
        return float(
            (irradiance * self.quantum_efficiency[channel] * self.filter_transmittance[channel]).sum()
            * self.fill_factor
            * (self.pitch_um * 1e-6) ** 2
        )

    def uniform(self, radiance: Array, kind: str = "flat") -> dict[str, Array]:
        """Images of a uniform field, e-/s by channel."""
        return {c: np.full((self.rows, self.cols), self.rate(radiance, c, kind)) for c in self.quantum_efficiency}

    def nominal_rate(self, radiance: Array) -> float:
        """Electrons a second of the brightest channel by the stated curves: exposures follow it, so that they don't
        tell what is concealed."""
        photons = radiance * WAVELENGTH_NM / HC_J_NM * np.pi / (4 * self.f_number**2 + 1) * self.lens_transmittance
        brightest = max(float((photons * q).sum()) for q in self.stated_efficiency.values())
        return brightest * self.fill_factor * (self.pitch_um * 1e-6) ** 2

    def exposure_for(self, radiance: Array, level: float) -> float:
        """Exposure (s) that fills the brightest channel to this share of saturation."""
        return float(np.round(level * self.full_well_e / self.nominal_rate(radiance), 9))

    def expose(self, images: dict[str, Array] | None, exposure_s: float, k: int, temperature_c: float = 25.0) -> Array:
        """Frame number `k` of images in e-/s by channel (before shading; None: no light), raw DN."""
        laws, shape, elapsed_s = self.laws, (self.rows, self.cols), STEP_S * k
        draw = k + DRAW_STEP * self.noise_draw
        for law in laws:
            law.frame = FrameTaken(draw, exposure_s, elapsed_s, temperature_c)
        rng = np.random.default_rng([self.seed, 2, draw])
        z = rng.standard_normal(shape)
        e: Array = np.zeros(shape)
        if images is not None:
            e = self._photoelectrons(images, exposure_s, elapsed_s, draw)
        dark: Array = np.full(shape, self.dark_e_per_s)
        for law in laws:
            dark = law.dark_rate(dark, temperature_c)
        e = np.maximum(e + dark * exposure_s, 0)
        for law in laws:
            e = e + law.lag_e(self._previous_e)
        self._previous_e = e
        mean, e = e, poisson(e, z)
        for law in laws:
            e = law.drawn_e(e, mean)
        for law in laws:
            e = law.response(e)
        e = e + self.dsnu_map_e + self.read_noise_e * rng.standard_normal(shape)
        for law in laws:
            e = e + law.noise_e(shape, draw)
        offset_dn = sum(law.offset_dn(elapsed_s, temperature_c) for law in laws)
        dn = self.black_level_dn + self.gain_dn_per_e * e + offset_dn
        for law in laws:
            dn = law.processed_dn(law.adc_output(dn))
        return np.clip(np.round(dn), 0, self.full_code_dn).astype(np.uint16)

    def _photoelectrons(self, images: dict[str, Array], exposure_s: float, elapsed_s: float, draw: int) -> Array:
        """Mean photoelectrons of the mosaic."""
        shaded = {}
        for c, image in images.items():
            shaded[c] = image * self.shading
            for law in self.laws:
                shaded[c] = law.image(shaded[c]) + law.ambient_e_per_s(c)
        for law in self.laws:
            shaded = law.colours(shaded)
        rate = self._mosaic(shaded) * self.prnu_map
        time_s = exposure_s
        for law in self.laws:
            rate = rate * law.source_factor(elapsed_s) * law.row_factors(self.rows, exposure_s, draw)
            time_s = law.collection_time_s(time_s)
        e = rate * time_s
        for law in self.laws:
            e = law.collected_e(e, rate)
        return e

    def _mosaic(self, images: dict[str, Array]) -> Array:
        if self.cfa == "MONO":
            return images["Y"]
        out = np.empty((self.rows, self.cols))
        for k, c in enumerate(self.cfa):
            out[k // 2 :: 2, k % 2 :: 2] = images[c][k // 2 :: 2, k % 2 :: 2]
        return out


def poisson(mean: Array, z: Array) -> Array:
    """Poisson numbers of the given means from standard normal ones, monotonic in both: by inversion for small means,
    else by the normal quantile with its skewness (Cornish and Fisher 1938)."""
    out = np.round(mean + np.sqrt(mean) * z + (z * z - 1.0) / 6.0)
    small = mean < NORMAL_FROM_E
    if np.any(small):
        out[small] = _poisson_quantile(mean[small], np.clip(ndtr(z[small]), 1e-12, 1 - 1e-12))
    return np.maximum(out, 0.0)


def _poisson_quantile(mean: Array, probability: Array) -> Array:
    """Least k at which the distribution function of a Poisson number reaches a probability, by adding its terms exp(-m)
    m^k / k!."""
    k = np.zeros_like(mean)
    term = np.exp(-mean)
    left = np.flatnonzero((probability > term) & (mean > 0))  # not reached by the terms up to `number`
    m, above, term, number = mean[left], probability[left] - term[left], term[left], 0
    while left.size:
        number += 1
        term = term * m / number
        above = above - term
        k[left] = number
        more = above > 0
        left, m, above, term = left[more], m[more], above[more], term[more]
    return k
