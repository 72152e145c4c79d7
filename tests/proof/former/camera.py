"""The second image former: a camera of another make than `sim`'s, and the recordings it takes.

It shares no stage with `sim` (only Spectrum and the recording set, which are plain data): spectra at 1 nm, the pupil's overlap by
Gauss's quadrature, edges as integrals along their normal, patterns on a grid four times finer than the pixels, Poisson draws by
inversion of one uniform number a pixel. The same camera with and without a law so makes the same noise: the difference of two
recordings is the law's alone.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline, RegularGridInterpolator
from scipy.special import ndtr, pdtrik

from lab.formats.recording_set import Manifest, RecordingSet
from sim.spectrum import Spectrum

from .laws import FULL_CODE, WL, Array, Law

HC_J_NM = 1.98644586e-16
NODES = np.arange(384.0, 781.0, 9.0)  # nm, at which transfer functions are formed
PUPIL = np.polynomial.legendre.leggauss(20)
FINE, PARTS = 4, 3  # samples a pixel of a pattern's picture; parts a side that each is the mean of
NORMAL_FROM_E = 60.0  # above, a Poisson number is a skewed normal one to 1e-3 of its standard deviation
PERIOD_PX, STEP_PX = 204.8, 0.025
STEP_S = 20.0  # from one capture to the next
DRAW_STEP = 100_000  # more than a session's frames: another draw of the noise has other numbers throughout


@dataclass(frozen=True)
class Plan:
    """What a session takes. `lights`: edges in narrowband light too; `warm`: darks at two more temperatures; `shuttle`: flats up and
    down again; `exposures`: edges at a quarter of the exposure and four times the light too."""

    kinds: tuple[str, ...] = ("dark", "flat", "narrowband", "chart", "slanted_edge", "screen")
    lights: bool = False
    warm: bool = False
    shuttle: bool = False
    exposures: bool = False
    repeats: int = 3


@dataclass(frozen=True)
class Pose:
    """A board before a camera: its middle at `centre_mm` (x right, y down, z away), turned about x, then y, then z (degrees)."""

    centre_mm: tuple[float, float, float]
    turn_deg: tuple[float, float, float]


class Camera:
    """One camera, drawn from `seed`, with laws built in. `cfa`, `f_number` None: drawn. `noise_draw`: which of the noises that the same
    camera may make; its fixed patterns stay. `offset_mm`: how far right of the pair's left camera it stands; `pair_middle_mm`: where boards for
    both stand."""

    def __init__(
        self, seed: int, laws: Sequence[Law] = (), *, cfa: str | None = None, f_number: float | None = None, rows: int = 384, cols: int = 512, noise_draw: int = 0,
        side: str = "left", offset_mm: float = 0.0, pair_middle_mm: float = 0.0,
    ) -> None:  # fmt: skip
        self.side, self.offset_mm, self.pair_middle_mm = side, offset_mm, pair_middle_mm
        self.seed, self.noise_draw, self.rows, self.cols = seed, noise_draw, rows, cols
        rng = np.random.default_rng([seed, 1])
        drawn = str(rng.choice(["RGGB", "BGGR", "GRBG", "GBRG", "MONO"], p=[0.2, 0.2, 0.2, 0.2, 0.2]))
        self.cfa = cfa or drawn
        self.pitch = float(rng.choice([2.2, 2.8, 3.0, 3.45, 3.75, 4.5]))
        self.fill = float(rng.uniform(0.5, 1.0))
        drawn_n = float(rng.choice([2.0, 2.8, 4.0, 5.6]))
        self.n = f_number or drawn_n
        self.focal = float(rng.choice([6.0, 8.0, 12.0]))
        self.tau = float(rng.uniform(0.85, 0.95))
        self.gain = float(rng.uniform(0.3, 0.6))
        self.read = float(rng.uniform(1.5, 5.0))
        self.dark = float(rng.uniform(2.0, 20.0))
        self.dsnu = float(rng.uniform(0.5, 1.5))
        self.prnu = float(rng.uniform(0.4, 1.0))
        self.black = float(rng.choice([64.0, 128.0, 168.0, 240.0]))
        self.full = (FULL_CODE - self.black) / self.gain
        peaks = (
            {"Y": (540, 95, 0.62)}
            if self.cfa == "MONO"
            else {"R": (605, 38, 0.5), "G": (530, 42, 0.52), "B": (455, 30, 0.48)}
        )
        edge = 1.0 / (1.0 + np.exp((WL - 705.0) / 8.0))
        scale, tilt = 1 + 0.02 * rng.standard_normal(), 0.015 * rng.standard_normal()
        self.maker: dict[str, Array] = {}
        self.qe: dict[str, Array] = {}
        for c, (peak, width, top) in peaks.items():
            mu, sd = peak + rng.uniform(-8, 8), width * rng.uniform(0.9, 1.1)
            curve = (top * np.exp(-0.5 * ((WL - mu) / sd) ** 2) + 0.02 * edge) * edge
            self.maker[c] = curve
            self.qe[c] = curve * (scale + 0.003 * rng.standard_normal() + tilt * (WL - 560.0) / 160.0)
        self.prnu_map = 1 + self.prnu / 100 * rng.standard_normal((rows, cols))
        self.dsnu_map = self.dsnu * rng.standard_normal((rows, cols))
        r, c = np.mgrid[:rows, :cols]
        half = 0.5 * float(np.hypot(rows, cols))
        #: (x, y) of the pixels in half diagonals from the middle.
        self.place = (c - (cols - 1) / 2) / half, (r - (rows - 1) / 2) / half
        radius_mm = np.hypot(*self.place) * half * self.pitch / 1000
        self.laws = tuple(laws)
        for law in self.laws:
            law.bind(self)
        self.shade = np.cos(np.arctan(radius_mm / self.focal)) ** 4
        for law in self.laws:
            self.shade = self.shade * law.shade(*self.place)
        self.through = {
            c: np.prod([np.ones_like(WL), *(law.transmission(c) * np.ones_like(WL) for law in self.laws)], axis=0)
            for c in self.qe
        }
        shape_rng = np.random.default_rng([seed, 5])
        #: Focal length and middle in px, k1 and k2: every lens distorts a little.
        self.focal_px = 1000 * self.focal / self.pitch * float(shape_rng.uniform(0.99, 1.01))
        self.middle = (cols - 1) / 2 + float(shape_rng.uniform(-3, 3)), (rows - 1) / 2 + float(shape_rng.uniform(-3, 3))
        self.bends = float(shape_rng.uniform(-0.3, 0.1)), float(shape_rng.uniform(-0.1, 0.1))
        self.frames: dict[str, Any] = {}
        self.spectra: dict[str, Spectrum] = {}
        self.captures: list[dict[str, Any]] = []
        self._last: Array | None = None
        self._mono: dict[float, Array] = {}

    # --- optics -------------------------------------------------------------------------------------------------------

    def diffraction(self, f_cy_um: Array, lam_um: float) -> Array:
        """Overlap of two discs."""
        s = np.clip(np.abs(f_cy_um) * lam_um * self.n, 0, 1)
        return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))

    def _pupil(self, f_cy_um: Array, angle: float, lam_nm: float) -> Array:
        """Autocorrelation of the aberrated pupil along a direction, complex; 20 x 20 nodes in the overlap."""
        node, weight = PUPIL
        s = np.clip(f_cy_um * lam_nm / 1000 * self.n, 0, 1)[:, None, None]  # half the separation, in pupil radii
        top = np.sqrt(np.clip(1 - s * s, 0, None))
        v = top * node[None, :, None]
        reach = np.sqrt(np.clip(1 - v * v, 0, None)) - s
        u = reach * node[None, None, :]
        cos, sin = np.cos(angle), np.sin(angle)
        path = np.zeros(np.broadcast_shapes(u.shape, v.shape))
        for law in self.laws:
            ahead = law.wavefront((u + s) * cos - v * sin, (u + s) * sin + v * cos, lam_nm)
            if ahead is not None:
                path = path + ahead - law.wavefront((u - s) * cos - v * sin, (u - s) * sin + v * cos, lam_nm)
        part = top * np.clip(reach, 0, None) * weight[None, :, None] * weight[None, None, :]
        return (part * np.exp(2j * np.pi * path / (lam_nm / 1000))).sum((1, 2)) / np.pi

    @cached_property
    def _aberrated(self) -> bool:
        return any(law.wavefront(np.zeros(1), np.zeros(1), 550.0) is not None for law in self.laws)

    def _lens(self, f_cy_px: Array, angle: float) -> Array:
        """(NODES, f): lens and silicon along a direction, without the grey factors."""
        f = np.asarray(f_cy_px) / self.pitch
        if not self._aberrated:
            table = np.array([self.diffraction(f, w / 1000) for w in NODES])
        else:
            key = round(angle, 9)
            coarse = np.linspace(0, 3.2, 81)
            if key not in self._mono:
                whole = np.array([self._pupil(coarse / self.pitch, angle, w) for w in NODES])
                self._mono[key] = whole / whole[:, :1]  # the quadrature's area is good to 1e-4
            table = CubicSpline(coarse, self._mono[key], axis=1)(np.minimum(f_cy_px, 3.2))
        for law in self.laws:
            table = table * np.array([law.mono(f, w / 1000) * np.ones_like(f) for w in NODES])
        return table

    def _shares(self, radiance: Array, channel: str) -> Array:
        """How much each of NODES counts, by photons and sensitivity at 1 nm."""
        weight = radiance * WL * self.qe[channel] * self.through[channel]
        at = np.clip((WL - NODES[0]) / (NODES[1] - NODES[0]), 0, len(NODES) - 1)
        left = np.minimum(at.astype(int), len(NODES) - 2)
        shares = np.bincount(left, weight * (1 - at + left), len(NODES)) + np.bincount(
            left + 1, weight * (at - left), len(NODES)
        )
        return shares / shares.sum()

    def _grey(self, fx: Array, fy: Array) -> Array:
        side = np.sqrt(self.fill) * self.pitch
        own = next((h for h in (law.aperture(fx, fy, side) for law in self.laws) if h is not None), None)
        out = np.sinc(side * fx) * np.sinc(side * fy) if own is None else own
        for law in self.laws:
            out = out * law.grey(fx, fy)
        return out

    def otf(self, f_cy_px: Array, angle: float, radiance: Array, channel: str) -> Array:
        """Along a direction (rad from x)."""
        f = np.asarray(f_cy_px) / self.pitch
        return (self._shares(radiance, channel) @ self._lens(f_cy_px, angle)) * self._grey(
            f * np.cos(angle), f * np.sin(angle)
        )

    # --- light --------------------------------------------------------------------------------------------------------

    def rate(self, radiance: Array, channel: str, kind: str = "flat") -> float:
        """Electrons a second on axis: pi L tau / (4 N^2 + 1) over the pixel's area."""
        for law in self.laws:
            radiance = law.radiance(radiance, kind)
        photons = radiance * WL / HC_J_NM
        irradiance = np.pi / (4 * self.n**2 + 1) * self.tau * photons
        return float(
            (irradiance * self.qe[channel] * self.through[channel]).sum() * self.fill * (self.pitch * 1e-6) ** 2
        )

    def uniform(self, radiance: Array, kind: str = "flat") -> dict[str, Array]:
        return {c: np.full((self.rows, self.cols), self.rate(radiance, c, kind)) for c in self.qe}

    def nominal_rate(self, radiance: Array) -> float:
        """Of the brightest channel by the maker's word: exposures are chosen by it, so that they don't tell what is concealed."""
        photons = radiance * WL / HC_J_NM * np.pi / (4 * self.n**2 + 1) * self.tau
        return max(float((photons * q).sum()) for q in self.maker.values()) * self.fill * (self.pitch * 1e-6) ** 2

    def exposure_for(self, radiance: Array, level: float) -> float:
        return float(np.round(level * self.full / self.nominal_rate(radiance), 9))

    def _mosaic(self, images: dict[str, Array]) -> Array:
        if self.cfa == "MONO":
            return images["Y"]
        out = np.empty((self.rows, self.cols))
        for k, c in enumerate(self.cfa):
            out[k // 2 :: 2, k % 2 :: 2] = images[c][k // 2 :: 2, k % 2 :: 2]
        return out

    # --- frames -------------------------------------------------------------------------------------------------------

    def expose(self, images: dict[str, Array] | None, exposure_s: float, k: int, temperature_c: float = 25.0) -> Array:
        """Frame number k of electrons a second by channel (before shading), None: no light. Raw DN."""
        laws, shape, elapsed = self.laws, (self.rows, self.cols), STEP_S * k
        turn = k + DRAW_STEP * self.noise_draw
        rng = np.random.default_rng([self.seed, 2, turn])
        z = rng.standard_normal(shape)
        e: Array = np.zeros(shape)
        if images is not None:
            lit = {}
            for c, image in images.items():
                lit[c] = image * self.shade
                for law in laws:
                    lit[c] = law.image(lit[c]) + law.ambient(c)
            rate = self._mosaic(lit) * self.prnu_map
            time = exposure_s
            for law in laws:
                rate = rate * law.source(elapsed) * law.rows(self.rows, exposure_s, turn)
                time = law.exposure(time)
            e = rate * time
            for law in laws:
                e = law.lit(e, rate)
        dark: Array = np.full(shape, self.dark)
        for law in laws:
            dark = law.dark(dark, temperature_c)
        e = np.maximum(e + dark * exposure_s, 0)
        for law in laws:
            e = e + law.lag(self._last)
        self._last = e
        mean, e = e, poisson(e, z)
        for law in laws:
            e = law.collected(e, mean)
        for law in laws:
            e = law.respond(e)
        e = e + self.dsnu_map + self.read * rng.standard_normal(shape)
        for law in laws:
            e = e + law.noise(shape, turn)
        dn = self.black + self.gain * e + sum(law.offset(elapsed, temperature_c) for law in laws)
        for law in laws:
            dn = law.processed(law.codes(dn))
        return np.clip(np.round(dn), 0, FULL_CODE).astype(np.uint16)

    def edge(self, angle_deg: float, radiance: Array, dark: float) -> dict[str, Array]:
        """A straight edge: the line spread's running integral along the normal."""
        a = np.deg2rad(angle_deg)
        x, y = self.place
        half = 0.5 * np.hypot(self.rows, self.cols)
        distance = half * (x * np.cos(a) + y * np.sin(a))
        n = round(PERIOD_PX / STEP_PX)
        f = np.fft.rfftfreq(n, STEP_PX)
        away = (np.arange(n) - n // 2) * STEP_PX
        out = {}
        for c in self.qe:
            h = np.where(f < 3.2, self.otf(np.minimum(f, 3.2), a, radiance, c), 0.0)
            # what one step of the normal holds of the line spread, summed up from the left
            held = np.fft.fftshift(np.fft.irfft(h * np.sinc(f * STEP_PX) * np.exp(1j * np.pi * f * STEP_PX), n))
            step = np.concatenate([[0.0], np.cumsum(held)[:-1]])
            out[c] = self.rate(radiance, c) * (dark + (1 - dark) * np.interp(distance, away, step))
        return out

    @cached_property
    def _moves(self) -> bool:
        return any(law.lands(np.zeros(1), np.zeros(1), 550.0) is not None for law in self.laws)

    def _unmoved(self, row: Array, col: Array, channel: str, radiance: Array) -> tuple[Array, Array]:
        """Where light that lands at a place (px) would without the laws' shifts: the mean over what the channel detects."""
        if not self._moves:
            return row, col
        shares = self._shares(radiance, channel)
        half = 0.5 * float(np.hypot(self.rows, self.cols))
        from_row, from_col = np.broadcast_arrays(row, col)
        for _ in range(2):  # the shifts are small: what they shift by at the place they come from
            x, y = (from_col - (self.cols - 1) / 2) / half, (from_row - (self.rows - 1) / 2) / half
            right, down = np.zeros(x.shape), np.zeros(x.shape)
            for law in self.laws:
                for share, w in zip(shares, NODES, strict=True):
                    moved = law.lands(x, y, float(w)) if abs(share) > 1e-6 else None
                    if moved is not None:
                        right, down = right + share * moved[0], down + share * moved[1]
            from_row, from_col = row - down, col - right
        return from_row, from_col

    def board(self, texture: Array, texel_mm: float, pose: Pose, radiance: Array) -> dict[str, Array]:
        """A flat printed board of `texture` (0 black .. 1 white) through pinhole, distortion and blur; dark around it."""
        a, b, c = np.deg2rad(pose.turn_deg)
        about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
        turn = about_z @ about_y @ about_x
        centre = np.array(pose.centre_mm) - [self.offset_mm, 0, 0]
        # where a place of the frame sees the board is smooth: worked out every few pixels, and splines between
        coarse = [np.linspace(-2.0, n + 1.0, n // 6 + 4) for n in (self.rows, self.cols)]
        fine_row, fine_col = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (self.rows, self.cols))
        inside = (np.arange(2) + 0.5) / 2 / FINE - 0.5 / FINE
        pictures: dict[str, Array] = {}
        for ch in self.qe:
            if pictures and not self._moves:
                pictures[ch] = next(iter(pictures.values()))
                continue
            row, col = self._unmoved(coarse[0][:, None], coarse[1][None, :], ch, radiance)
            xd, yd = np.broadcast_arrays((col - self.middle[0]) / self.focal_px, (row - self.middle[1]) / self.focal_px)
            xu, yu = xd, yd
            for _ in range(6):
                r2 = xu * xu + yu * yu
                stretch = 1 + self.bends[0] * r2 + self.bends[1] * r2 * r2
                xu, yu = xd / stretch, yd / stretch
            # the ray meets the plane of normal turn[:, 2] through the centre
            depth = (turn[:, 2] @ centre) / (turn[0, 2] * xu + turn[1, 2] * yu + turn[2, 2])
            away = xu * depth - centre[0], yu * depth - centre[1], depth - centre[2]
            across, down = (
                RectBivariateSpline(*coarse, sum(turn[k, axis] * away[k] for k in range(3)) / texel_mm)
                for axis in (0, 1)
            )
            fine = np.zeros((self.rows * FINE, self.cols * FINE))
            for y, x in itertools.product(inside, inside):
                i = down(fine_row + y, fine_col + x) + texture.shape[0] / 2
                j = across(fine_row + y, fine_col + x) + texture.shape[1] / 2
                fine += squares_at(texture, i, j) / 4
            pictures[ch] = fine
        filtered = self._filtered(pictures, radiance, FINE)
        return {ch: self.rate(radiance, ch) * (0.04 + 0.86 * image) for ch, image in filtered.items()}

    def pattern(self, target: Array, radiance: Array, dark: float, cell_px: float = 4.0) -> dict[str, Array]:
        """Cells on a screen, turned by 0.6 degrees, drawn on the fine grid and filtered there."""
        r = ((np.arange(self.rows * FINE) + 0.5) / FINE - 0.5 - (self.rows - 1) / 2)[:, None]
        c = ((np.arange(self.cols * FINE) + 0.5) / FINE - 0.5 - (self.cols - 1) / 2)[None, :]
        t = np.deg2rad(0.6)
        # each fine sample is a mean over its square: else the cells' turned rims would be jagged
        inside = (np.arange(PARTS) + 0.5) / PARTS / FINE - 0.5 / FINE
        middle = (self.rows - 1) / 2, (self.cols - 1) / 2
        coarse = [np.linspace(-2.0, n + 1.0, n // 6 + 4) for n in (self.rows, self.cols)]
        pictures: dict[str, Array] = {}
        for ch in self.qe:
            if pictures and not self._moves:
                pictures[ch] = next(iter(pictures.values()))
                continue
            fine = np.zeros((self.rows * FINE, self.cols * FINE))
            sources = self._unmoved(coarse[0][:, None], coarse[1][None, :], ch, radiance) if self._moves else ()
            for y, x in itertools.product(inside, inside):
                down, right = r + y, c + x
                if self._moves:
                    at = down[:, 0] + middle[0], right[0] + middle[1]
                    down, right = (
                        RectBivariateSpline(*coarse, m)(*at) - o for m, o in zip(sources, middle, strict=True)
                    )
                i = (down * np.cos(t) - right * np.sin(t)) / cell_px + target.shape[0] / 2
                j = (down * np.sin(t) + right * np.cos(t)) / cell_px + target.shape[1] / 2
                fine += squares_at(target, i, j) / PARTS**2
            for law in self.laws:
                fine = law.screen(fine, r, c)
            pictures[ch] = fine
        return {
            ch: self.rate(radiance, ch) * (dark + (1 - dark) * im)
            for ch, im in self._filtered(pictures, radiance, FINE).items()
        }

    def _filtered(self, pictures: dict[str, Array], radiance: Array, over: int) -> dict[str, Array]:
        """Pictures on a grid `over` times finer than the pixels through the OTF, at the pixels' centres; the rim is continued."""
        out: dict[str, Array] = {}
        grid_f, grid_a = np.linspace(0, 2.9, 88), np.linspace(-np.pi / 2, np.pi / 2, 13 if self._aberrated else 2)
        pad = 24 * over
        spectra: dict[int, Array] = {}
        for ch, picture in pictures.items():
            if id(picture) not in spectra:
                spectra[id(picture)] = np.fft.rfft2(np.pad(picture, pad, mode="edge"))
            shape = (picture.shape[0] + 2 * pad, picture.shape[1] + 2 * pad)
            fy, fx = np.fft.fftfreq(shape[0], 1 / over)[:, None], np.fft.rfftfreq(shape[1], 1 / over)[None, :]
            radius = np.minimum(np.hypot(fx, fy), 2.9)
            shares = self._shares(radiance, ch)
            table = np.array([shares @ self._lens(grid_f, a) for a in grid_a])
            h = (
                RegularGridInterpolator((grid_a, grid_f), table)((np.arctan2(fy, fx), radius))
                if self._aberrated
                else np.interp(radius, grid_f, table[0])
            )
            h = h * self._grey(fx / self.pitch, fy / self.pitch)
            if over > 1:
                h = h / (np.sinc(fx / over) * np.sinc(fy / over))  # the samples' own squares
            # samples lie at (k + 0.5) / over - 0.5: half a fine step less half a pixel is taken out with the phase
            turn = np.exp(2j * np.pi * (fx + fy) * (0.5 - 0.5 / over))
            out[ch] = np.fft.irfft2(spectra[id(picture)] * h * turn, shape)[
                pad : shape[0] - pad : over, pad : shape[1] - pad : over
            ]
        return out

    def chart(self, light: Array, box: tuple[int, int, int, int]) -> dict[str, Array]:
        """A ColorChecker of published reflectances on a grey card, through the lens."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from colour import SDS_COLOURCHECKERS
        patches = [np.interp(WL, p.wavelengths, p.values) for p in SDS_COLOURCHECKERS["BabelColor Average"].values()]
        row0, col0, row1, col1 = box
        gap = max(1, round(0.01 * self.rows))
        images = {}
        for c in self.qe:
            image = np.full((self.rows, self.cols), self.rate(0.18 * light, c))
            h, w = (row1 - row0) / 4, (col1 - col0) / 6
            for k, reflectance in enumerate(patches):
                i, j = divmod(k, 6)
                rows = slice(round(row0 + i * h) + gap, round(row0 + (i + 1) * h) - gap)
                image[rows, round(col0 + j * w) + gap : round(col0 + (j + 1) * w) - gap] = self.rate(
                    reflectance * light, c
                )
            images[c] = image
        return self._filtered(images, light, 1)

    # --- sessions -----------------------------------------------------------------------------------------------------

    def take(
        self,
        kind: str,
        images: dict[str, Array] | None,
        exposure_s: float,
        repeats: int = 1,
        temperature_c: float = 25.0,
        **more: Any,
    ) -> None:
        mark = "" if self.side == "left" else "right-"
        for law in self.laws if images is not None else ():
            images = {c: image * law.scene(kind) for c, image in images.items()}
        for _ in range(repeats):
            k = len(self.captures)
            path = f"frames/{mark}{k:04d}.npy"
            self.frames[path] = self.expose(images, exposure_s, k, temperature_c)
            when = datetime(2026, 3, 2, 9, tzinfo=UTC) + timedelta(seconds=STEP_S * k)
            self.captures.append(
                {"id": f"{mark}c{k:04d}", "kind": kind, "side": self.side, "frame": path, "exposure_s": exposure_s,
                 "temperature_c": temperature_c, "time": when.isoformat(), **more}
            )  # fmt: skip

    def note(self, radiance: Array) -> str:
        """The file in which the radiometer's reading of a light is kept."""
        path = f"spectra/{'' if self.side == 'left' else 'right-'}{len(self.spectra):03d}.csv"
        self.spectra[path] = Spectrum.of(WL, radiance)
        return path

    def record(self, plan: Plan = Plan(), name: str = "camera") -> RecordingSet:
        """Take a session. What is asked for (exposures, order, names) doesn't depend on the laws."""
        rng = np.random.default_rng([self.seed, 4])
        lamp = 0.05 * np.exp((WL - 560) / 400) * (1 + 0.1 * np.sin(WL / 60))
        curves = {c: self.note(q) for c, q in self.maker.items()}
        targets: dict[str, Array] = {}
        for kind in plan.kinds:
            {
                "dark": self._darks,
                "flat": self._flats,
                "narrowband": self._sweep,
                "chart": self._charts,
                "slanted_edge": self._edges,
                "charuco": self._boards,
            }.get(kind, lambda _plan, light: targets.update(self._screen(rng, light)))(plan, lamp)
        camera = {
            "rows": self.rows, "cols": self.cols, "pixel_pitch_um": self.pitch, "fill_factor": self.fill, "cfa": self.cfa,
            "bit_depth": 12, "black_level_dn": self.black, "white_level_dn": FULL_CODE, "f_number": self.n, "focal_length_mm": self.focal,
            "lens_transmittance": self.tau, "quantum_efficiency": curves,
        }  # fmt: skip
        manifest = Manifest.model_validate({"name": name, "cameras": {self.side: camera}, "captures": self.captures})
        return RecordingSet(manifest, self.frames, self.spectra, targets, source=name)

    def _darks(self, plan: Plan, lamp: Array) -> None:
        for t in (0.001, 0.5, 2.0):
            self.take("dark", None, t, max(plan.repeats, 3))
        for warmer in (35.0, 45.0) if plan.warm else ():
            self.take("dark", None, 2.0, max(plan.repeats, 3), warmer)

    def _flats(self, plan: Plan, lamp: Array) -> None:
        path, images = self.note(lamp), self.uniform(lamp)
        levels = (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.92)
        order = (*levels, *levels[::-1]) if plan.shuttle else levels
        for level in order:
            self.take(
                "flat",
                images,
                self.exposure_for(lamp, level),
                2 if plan.shuttle else max(plan.repeats, 3),
                radiance=path,
            )

    def _sweep(self, plan: Plan, lamp: Array) -> None:
        def line(w: float) -> Array:
            return 0.004 * np.exp((w - 560) / 300) * np.exp(-0.5 * ((WL - w) / 4.2466) ** 2)

        t = min(self.exposure_for(line(w), 0.8) for w in range(400, 721, 20))
        for w in range(400, 721, 10):
            self.take(
                "narrowband",
                self.uniform(line(w), "narrowband"),
                t,
                wavelength_nm=w,
                bandwidth_nm=10,
                radiance=self.note(line(w)),
            )

    def _charts(self, plan: Plan, lamp: Array) -> None:
        light = 0.3 * lamp
        box = round(0.14 * self.rows), round(0.12 * self.cols), round(0.86 * self.rows), round(0.88 * self.cols)
        row0, col0, row1, col1 = box
        corners = [[row0, col0], [row0, col1], [row1, col1], [row1, col0]]
        self.take("chart", self.chart(light, box), self.exposure_for(0.9 * light, 0.8), 2, chart="ColorChecker24",
                  corners=corners, radiance=self.note(light))  # fmt: skip

    def _edges(self, plan: Plan, lamp: Array) -> None:
        half = min(100, self.rows // 2 - 4)
        region = [self.rows // 2 - half, self.cols // 2 - half, self.rows // 2 + half, self.cols // 2 + half]
        lights = [lamp]
        if plan.lights:
            lights += [0.05 * np.exp(-0.5 * ((WL - w) / 4.2466) ** 2) for w in (460.0, 640.0)]
        if plan.exposures:
            lights += [4.0 * lamp]
        for light in lights:
            path = self.note(light)
            for angle in (5.0, 95.0, -40.0, 2.6):
                self.take("slanted_edge", self.edge(angle, light, 0.08), self.exposure_for(light, 0.8), 2, region=region,
                          angle_deg=angle, light_radiance=path, field_mm=[0.0, 0.0])  # fmt: skip

    def _boards(self, plan: Plan, lamp: Array) -> None:
        """A ChArUco board of 6 x 8 squares in ten poses, tilted to all sides, each square 9 mm."""
        board = cv2.aruco.CharucoBoard((8, 6), 9.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        texture = np.asarray(board.generateImage((8 * 18, 6 * 18), marginSize=0, borderBits=1)) / 255.0
        light = 0.6 * lamp
        # so far that the board covers three quarters of the frame
        away = 9.0 * max(8 / self.cols, 6 / self.rows) / 0.75 * self.focal_px
        x, y = 0.1 * away * self.cols / self.focal_px, 0.1 * away * self.rows / self.focal_px
        tilts = (
            (0, 0, 0),
            (35, 0, 3),
            (-35, 0, -4),
            (0, 35, 5),
            (0, -35, 2),
            (25, 25, -6),
            (-25, 25, 4),
            (25, -25, 8),
            (-25, -25, -3),
            (10, -15, 20),
        )
        for k, tilt in enumerate(tilts):
            place = (x * ((k * 7) % 5 - 2) / 2, y * ((k * 3) % 5 - 2) / 2, away * (1 + 0.03 * (k % 4)))
            if self.pair_middle_mm:
                place = (place[0] + self.pair_middle_mm, place[1], place[2])
            self.take("charuco", self.board(texture, 0.5, Pose(place, tilt), light), self.exposure_for(light, 0.7),
                      dictionary="DICT_4X4_50", squares=[6, 8], square_mm=9.0, marker_mm=6.0, pose=f"b{k}")  # fmt: skip

    def _screen(self, rng: np.random.Generator, lamp: Array) -> dict[str, Array]:
        screen = 0.1 * lamp
        path = self.note(screen)
        board = np.kron(np.indices((10, 13)).sum(0) % 2, np.ones((8, 8), int)).astype(np.uint8)
        noise = np.zeros((80, 104), np.uint8)
        noise[4:-4, 4:-4] = rng.integers(0, 2, (72, 96))
        t = self.exposure_for(screen, 0.8)
        where = {"screen": {"pose": "p0", "cell_camera_px": 4.0, "radiance": path}}
        self.take("white", self.pattern(np.ones((80, 104)), screen, 0.0035), t, 3, **where)
        self.take("black", self.pattern(np.zeros((80, 104)), screen, 0.0035), t, 3, **where)
        targets = {"targets/0.npy": board, "targets/1.npy": noise}
        for kind, (file, target) in zip(("checkerboard", "bernoulli"), targets.items(), strict=True):
            self.take(kind, self.pattern(target, screen, 0.0035), t, 3, target=file, **where)
        return targets


def pair(left: Camera, right: Camera, plan: Plan, name: str = "pair") -> RecordingSet:
    """Both cameras' sessions in one recording set."""
    one, two = left.record(plan, name), right.record(plan, name)
    whole = {
        "name": name,
        "cameras": {
            **one.manifest.model_dump(mode="json")["cameras"],
            **two.manifest.model_dump(mode="json")["cameras"],
        },
        "captures": [*left.captures, *right.captures],
    }
    targets = {c["target"]: one.target(c["target"]) for c in left.captures if c.get("target")}
    return RecordingSet(
        Manifest.model_validate(whole), left.frames | right.frames, left.spectra | right.spectra, targets, source=name
    )


def squares_at(picture: Array, row: Array, col: Array) -> Array:
    """The squares of a picture in which places lie, its first corner at (0, 0); nothing beyond it."""
    framed = np.pad(picture.astype(float), 1)
    i, j = (
        np.clip(np.floor(at).astype(np.int32), -1, count) + 1
        for at, count in zip((row, col), picture.shape, strict=True)
    )
    return np.asarray(framed[i, j])


def poisson(mean: Array, z: Array) -> Array:
    """Poisson numbers of the given means from standard normal ones, monotonic in both: inversion for small means, else the normal
    quantile with its skewness (Cornish and Fisher 1938)."""
    out = np.round(mean + np.sqrt(mean) * z + (z * z - 1.0) / 6.0)
    small = mean < NORMAL_FROM_E
    if np.any(small):
        m = mean[small]
        # pdtrik gives the k at which the distribution reaches p, between the integers; none below P(0)
        p = np.clip(ndtr(z[small]), 1e-12, 1 - 1e-12)
        some = (m > 0) & (p > np.exp(-m))
        k = np.zeros_like(m)
        k[some] = np.ceil(pdtrik(p[some], m[some]) - 1e-9)
        out[small] = k
    return np.maximum(out, 0.0)
