"""A second image former, for proofs: it shares no stage with `sim`, so that an error in one doesn't hide in the other.

Transfer functions in closed form along an edge's normal, spectra at 1 nm, a pattern drawn on a 4 times finer grid, laws of the
effects that differ from the library's (`variant`). It makes recording sets in memory, with the truth beside them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.special import erfc, j0, j1

from lab.recording import Manifest, RecordingSet
from sim.spectrum import Spectrum

WL = np.arange(380.0, 781.0)
HC_NM = 1.98644586e-16  # J nm
SIX = ("optical_low_pass_filter", "defocus", "charge_diffusion", "veiling_glare", "infrared_cut_filter", "nonlinearity")


@dataclass
class Body:
    """One camera, drawn at random, and what it conceals: effect -> strength."""

    seed: int
    effects: dict[str, float] = field(default_factory=dict)
    variant: int = 0
    cfa: str | None = None
    rows: int = 384
    cols: int = 512

    def __post_init__(self) -> None:
        rng = self.rng = np.random.default_rng(self.seed)
        self.cfa = self.cfa or str(
            rng.choice(["RGGB", "BGGR", "GRBG", "GBRG", "MONO"], p=[0.22, 0.22, 0.21, 0.21, 0.14])
        )
        self.pitch = float(rng.choice([2.2, 2.8, 3.0, 3.45, 3.75, 4.5]))
        self.fill = float(rng.uniform(0.5, 1.0))
        self.n = float(rng.choice([2.0, 2.8, 4.0, 5.6]))
        self.focal = float(rng.choice([6.0, 8.0, 12.0]))
        self.tau = float(rng.uniform(0.85, 0.95))
        self.gain = float(rng.uniform(0.3, 0.6))
        self.read = float(rng.uniform(1.5, 5.0))
        self.dark = float(rng.uniform(2.0, 20.0))
        self.dsnu = float(rng.uniform(0.5, 1.5))
        self.prnu = float(rng.uniform(0.4, 1.0))
        self.black = float(rng.choice([64.0, 128.0, 168.0, 240.0]))
        self.full = (4095 - self.black) / self.gain
        peaks = (
            {"R": (605, 38, 0.5), "G": (530, 42, 0.52), "B": (455, 30, 0.48)}
            if self.cfa != "MONO"
            else {"Y": (540, 95, 0.62)}
        )
        edge = 1.0 / (1.0 + np.exp((WL - 705.0) / 8.0))
        self.maker, self.qe = {}, {}
        scale, tilt = 1 + 0.02 * rng.standard_normal(), 0.015 * rng.standard_normal()
        for c, (peak, width, top) in peaks.items():
            mu, sd = peak + rng.uniform(-8, 8), width * rng.uniform(0.9, 1.1)
            curve = (top * np.exp(-0.5 * ((WL - mu) / sd) ** 2) + 0.02 * edge) * edge
            self.maker[c] = curve
            self.qe[c] = curve * (scale + 0.003 * rng.standard_normal() + tilt * (WL - 560.0) / 160.0)
        self.prnu_map = 1 + self.prnu / 100 * rng.standard_normal((self.rows, self.cols))
        self.dsnu_map = self.dsnu * rng.standard_normal((self.rows, self.cols))
        r, c = np.mgrid[: self.rows, : self.cols]
        rad = np.hypot(r - (self.rows - 1) / 2, c - (self.cols - 1) / 2) * self.pitch / 1000
        self.shade = np.cos(np.arctan(rad / self.focal)) ** 4
        self.frames_: dict[str, Any] = {}
        self.spectra_: dict[str, Any] = {}
        self.captures_: list[dict[str, Any]] = []
        self.filter_ = self._filter()

    # --- the effects' laws, varied -------------------------------------------------------------------------------------

    def _filter(self) -> np.ndarray:
        t = np.ones_like(WL)
        if "infrared_cut_filter" in self.effects:
            cut = self.effects["infrared_cut_filter"]
            if self.variant % 3 == 0:
                t = 1 / (1 + np.exp((WL - cut) / 6.0))
            elif self.variant % 3 == 1:
                t = 0.5 * erfc((WL - cut) / (np.sqrt(2) * 10.0))
            else:
                t = 0.97 / (1 + ((WL / cut) ** 2 - 1 + 1) ** 60)
        if "fringe" in self.effects:
            t = t * (1 + self.effects["fringe"] * np.cos(2 * np.pi * 20000.0 / WL))
        return t

    def otf(self, f: np.ndarray, angle: float, light: np.ndarray, channel: str) -> np.ndarray:
        """Along a direction (rad from x), cycles a px, weighted by light (photons) and sensitivity at 1 nm by 4."""
        fu = f / self.pitch
        fx, fy = fu * np.cos(angle), fu * np.sin(angle)
        weight = light * self.qe[channel] * self.filter_
        total, out = 0.0, np.zeros_like(f)
        for i in range(0, len(WL), 4):
            w = weight[i : i + 4].sum()
            if w <= 1e-6 * weight.sum():
                continue
            lam = WL[min(i + 2, len(WL) - 1)] / 1000
            out = out + w * self._mono(fu, fx, fy, lam)
            total += w
        side = np.sqrt(self.fill) * self.pitch
        return out / total * np.sinc(side * fx) * np.sinc(side * fy) * self._grey(fu, fx, fy)

    def _mono(self, fu: np.ndarray, fx: np.ndarray, fy: np.ndarray, lam: float) -> np.ndarray:
        s = np.clip(np.abs(fu) * lam * self.n, 0, 1)
        h = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
        if "defocus" in self.effects:
            w = self.effects["defocus"] / (8 * self.n**2)
            if self.variant % 2 == 0:  # trapezoid over the overlap of the pupils, by its width
                u = (np.arange(200) + 0.5) / 200
                x = u[None, :] * (1 - s[:, None])
                chord = np.sqrt(np.clip(1 - (x + s[:, None]) ** 2, 0, None))
                ph = 2 * np.pi / lam * 4 * w * s[:, None] * x
                h = 4 / np.pi * (1 - s) * (chord * np.cos(ph)).mean(1)
            else:  # Stokseth's closed form
                a = 4 * np.pi / lam * w * (2 * s) * (1 - s)
                h = h * np.where(np.abs(a) < 1e-6, 1.0, 2 * j1(np.where(a == 0, 1, a)) / np.where(a == 0, 1, a))
        if "charge_diffusion" in self.effects:
            d = self.effects["charge_diffusion"]
            if self.variant % 3 == 0:
                h = h * np.exp(-2 * (np.pi * d * fu) ** 2)
            elif self.variant % 3 == 1:
                d = d * (lam / 0.55) ** 2
                h = h * np.exp(-2 * (np.pi * d * fu) ** 2)
            else:  # absorbed along the depth, spread by the square root of what is left to drift
                depth, alpha = 4.0, 1 / (0.13 * (lam / 0.4) ** 5.5)
                z = (np.arange(40) + 0.5) / 40 * depth
                p = np.exp(-alpha * z)
                var = (1.6 * d) ** 2 * z / depth
                h = h * (p[:, None] * np.exp(-2 * np.pi**2 * var[:, None] * fu[None, :] ** 2)).sum(0) / p.sum()
        return h

    def _grey(self, fu: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        h = np.ones_like(fu)
        if "optical_low_pass_filter" in self.effects:
            d = self.effects["optical_low_pass_filter"]
            e = d * (1.0 if self.variant % 2 == 0 else 0.8)
            h = h * np.cos(np.pi * fx * d) * np.cos(np.pi * fy * e)
        if "motion" in self.effects:
            h = h * np.sinc(self.effects["motion"] * fx)
        if "vibration" in self.effects:
            h = h * j0(2 * np.pi * self.effects["vibration"] * fy)
        if "ghost_image" in self.effects:  # a second image, 2.5 px aside: nobody lists it
            r = self.effects["ghost_image"]
            h = h * np.abs((1 - r) + r * np.exp(2j * np.pi * fx * 2.5 * self.pitch))
        return h

    def response(self, e: np.ndarray) -> np.ndarray:
        if "nonlinearity" in self.effects:
            a = self.effects["nonlinearity"] / 100
            x = e / self.full
            if self.variant % 3 == 0:
                return e * (1 - a * x)
            if self.variant % 3 == 1:
                return self.full * np.where(x > 0, np.tanh(np.sqrt(3 * a) * x) / np.sqrt(3 * a), x)
            return e * np.clip(x, 1e-6, None) ** (-0.4 * a)
        return e

    # --- frames --------------------------------------------------------------------------------------------------------

    def rate(self, radiance: np.ndarray, channel: str) -> float:
        """Electrons a second on axis."""
        photons = radiance * WL / HC_NM
        irradiance = np.pi / (4 * self.n**2 + 1) * self.tau * photons
        return float((irradiance * self.qe[channel] * self.filter_).sum() * self.fill * (self.pitch * 1e-6) ** 2)

    def mosaic(self, images: dict[str, np.ndarray]) -> np.ndarray:
        if self.cfa == "MONO":
            return images["Y"]
        out = np.empty((self.rows, self.cols))
        for k, c in enumerate(str(self.cfa)):
            out[k // 2 :: 2, k % 2 :: 2] = images[c][k // 2 :: 2, k % 2 :: 2]
        return out

    def expose(self, images: dict[str, np.ndarray] | None, exposure_s: float) -> np.ndarray:
        """Images: electrons a second, full resolution by channel, without shading."""
        rng = self.rng
        e = np.zeros((self.rows, self.cols))
        if images is not None:
            lit = {}
            for c, image in images.items():
                im = np.asarray(image, float) * self.shade
                g = self.effects.get("veiling_glare", 0.0) / 100
                # in one of three variants half of it stays within a wide halo
                veil = (
                    0.5 * (im.mean() + gaussian_filter(im, 120, mode="nearest")) if self.variant % 3 == 2 else im.mean()
                )
                lit[c] = (1 - g) * im + g * veil if g else im
            e = self.mosaic(lit) * exposure_s * self.prnu_map
            if "tap_gain" in self.effects:
                e[:, self.cols // 2 :] *= 1 + self.effects["tap_gain"]
        e = np.maximum(e + self.dark * exposure_s, 0)
        e = rng.poisson(e) if e.max() < 1e6 else e
        e = self.response(np.asarray(e, float))
        e = e + self.dsnu_map + self.read * rng.standard_normal(e.shape)
        dn = self.black + self.gain * e
        if "row_banding" in self.effects:
            dn = dn + self.effects["row_banding"] * rng.standard_normal((self.rows, 1))
        return np.clip(np.round(dn), 0, 4095).astype(np.uint16)

    def take(
        self, kind: str, images: dict[str, np.ndarray] | None, exposure_s: float, repeats: int = 1, **more: Any
    ) -> None:
        for _ in range(repeats):
            k = len(self.captures_)
            name = f"{kind}-{k:03d}"
            self.frames_[f"frames/{name}.npy"] = self.expose(images, exposure_s)
            when = datetime(2026, 3, 2, 9, tzinfo=UTC) + timedelta(seconds=30 * k)
            self.captures_.append(
                {"id": name, "kind": kind, "side": "left", "frame": f"frames/{name}.npy", "exposure_s": exposure_s,
                 "temperature_c": 25.0, "time": when.isoformat(), **more}
            )  # fmt: skip

    def spectrum(self, name: str, radiance: np.ndarray) -> str:
        path = f"spectra/{name}.csv"
        self.spectra_[path] = Spectrum.of(WL, radiance)
        return path

    def uniform(self, radiance: np.ndarray) -> dict[str, np.ndarray]:
        return {c: np.full((self.rows, self.cols), self.rate(radiance, c)) for c in self.qe}

    def best_exposure(self, images: dict[str, np.ndarray], level: float = 0.8) -> float:
        return level * self.full / max(float(im.max()) for im in images.values())

    def edge_images(self, angle_deg: float, radiance: np.ndarray, dark: float) -> dict[str, np.ndarray]:
        a = np.deg2rad(angle_deg)
        r, c = np.mgrid[: self.rows, : self.cols]
        distance = (c - 0.5 * (self.cols - 1)) * np.cos(a) + (r - 0.5 * (self.rows - 1)) * np.sin(a)
        f = (np.arange(3000) + 0.5) * 0.001
        d = np.linspace(-60, 60, 4801)
        out = {}
        for ch in self.qe:
            h = self.otf(f, a, radiance * WL, ch)
            esf = 0.5 + (h / f)[None, :] @ np.sin(2 * np.pi * f[:, None] * d[None, :]) * 0.001 / np.pi
            esf = esf[0]
            # the integral's step of 0.001 cy/px repeats the edge at 500 px: harmless at 60 px
            out[ch] = self.rate(radiance, ch) * (dark + (1 - dark) * np.interp(distance, d, esf))
        return out

    def pattern_images(
        self, target: np.ndarray, radiance: np.ndarray, dark: float, cell: float = 4.0
    ) -> dict[str, np.ndarray]:
        over = 4
        r, c = (np.arange(self.rows * over) + 0.5) / over - 0.5, (np.arange(self.cols * over) + 0.5) / over - 0.5
        t = np.deg2rad(0.6)
        rr, cc = r[:, None] - (self.rows - 1) / 2, c[None, :] - (self.cols - 1) / 2
        i = np.floor((rr * np.cos(t) - cc * np.sin(t)) / cell + target.shape[0] / 2).astype(int)
        j = np.floor((rr * np.sin(t) + cc * np.cos(t)) / cell + target.shape[1] / 2).astype(int)
        ok = (i >= 0) & (i < target.shape[0]) & (j >= 0) & (j < target.shape[1])
        fine = np.where(ok, target[np.clip(i, 0, target.shape[0] - 1), np.clip(j, 0, target.shape[1] - 1)], 0.0)
        fine = (
            np.pad(fine, [(0, self.rows * over), (0, self.cols * over)]) if self.variant % 2 else fine
        )  # else it wraps
        spectrum = np.fft.rfft2(fine)
        fy, fx = np.fft.fftfreq(fine.shape[0], 1 / over)[:, None], np.fft.rfftfreq(fine.shape[1], 1 / over)[None, :]
        radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx)
        grid_f, grid_a = np.linspace(0, 2.9, 60), np.linspace(-np.pi / 2, np.pi / 2, 25)
        out = {}
        for ch in self.qe:
            table = np.array([self.otf(grid_f, a, radiance * WL, ch) for a in grid_a])
            h = RegularGridInterpolator((grid_a, grid_f), table)((angle, np.minimum(radius, 2.9)))
            # samples of the fine grid lie at (k + 0.5) / over - 0.5: half a fine step is taken out with the phase
            shift = np.exp(2j * np.pi * (fx + fy) * (0.5 - 0.5 / over))
            image = np.fft.irfft2(spectrum * h * shift, fine.shape)[::over, ::over][: self.rows, : self.cols]
            out[ch] = self.rate(radiance, ch) * (dark + (1 - dark) * image)
        return out

    def record(
        self, kinds: tuple[str, ...] = ("dark", "flat", "narrowband", "chart", "slanted_edge", "screen")
    ) -> RecordingSet:
        rng = self.rng
        lamp = 0.05 * np.exp((WL - 560) / 400) * (1 + 0.1 * np.sin(WL / 60))
        if "dark" in kinds:
            for t in (0.001, 0.5, 2.0):
                self.take("dark", None, t, 4)
        if "flat" in kinds:
            path, images = self.spectrum("lamp", lamp), self.uniform(lamp)
            top = self.best_exposure(images, 1.0)
            for level in (0.05, 0.12, 0.22, 0.35, 0.5, 0.65, 0.8, 0.95):
                self.take("flat", images, top * level, 3, radiance=path)
        if "narrowband" in kinds:
            strength = 0.0
            for w in range(400, 721, 10):
                shape = np.exp(-0.5 * ((WL - w) / 4.2466) ** 2)
                line = 0.004 * np.exp((w - 560) / 300) * shape
                if strength == 0.0:
                    worst = max(float(self.rate(0.004 * np.exp((v - 560) / 300) * np.exp(-0.5 * ((WL - v) / 4.2466) ** 2), c))
                                for v in range(400, 721, 20) for c in self.qe)  # fmt: skip
                    strength = 1.3 * self.full / worst
                self.take("narrowband", self.uniform(line), strength, wavelength_nm=w, bandwidth_nm=10,
                          radiance=self.spectrum(f"nb{w}", line))  # fmt: skip
        if "chart" in kinds:
            self._chart(0.3 * lamp)
        if "slanted_edge" in kinds:
            light, path = lamp, self.spectrum("edgelight", lamp)
            region = [self.rows // 2 - 100, self.cols // 2 - 100, self.rows // 2 + 100, self.cols // 2 + 100]
            for angle in (5.0, 95.0, -40.0, 2.6):
                images = self.edge_images(angle, light, 0.08)
                self.take("slanted_edge", images, self.best_exposure(self.uniform(light), 0.82), 2, region=region, angle_deg=angle,
                          light_radiance=path, dark_radiance=None, field_mm=[0.0, 0.0])  # fmt: skip
        targets = {}
        if "screen" in kinds:
            screen = 0.1 * lamp
            path = self.spectrum("screen", screen)
            board = np.kron(np.indices((10, 13)).sum(0) % 2, np.ones((8, 8), int)).astype(np.uint8)
            noise = np.zeros((80, 104), np.uint8)
            noise[4:-4, 4:-4] = rng.integers(0, 2, (72, 96))
            targets = {"targets/checkerboard.npy": board, "targets/bernoulli.npy": noise}
            t = self.best_exposure(self.uniform(screen), 0.8)
            where = {"screen": {"pose": "p0", "cell_camera_px": 4.0, "radiance": path}}
            self.take("white", self.pattern_images(np.ones((80, 104)), screen, 0.0035), t, 3, **where)
            self.take("black", self.pattern_images(np.zeros((80, 104)), screen, 0.0035), t, 3, **where)
            for kind, name in (("checkerboard", "targets/checkerboard.npy"), ("bernoulli", "targets/bernoulli.npy")):
                self.take(kind, self.pattern_images(targets[name], screen, 0.0035), t, 3, target=name, **where)
        camera = {
            "rows": self.rows, "cols": self.cols, "pixel_pitch_um": self.pitch, "fill_factor": self.fill, "cfa": self.cfa,
            "bit_depth": 12, "black_level_dn": self.black, "white_level_dn": 4095, "f_number": self.n, "focal_length_mm": self.focal,
            "lens_transmittance": self.tau, "quantum_efficiency": {c: self.spectrum(f"qe_{c}", q) for c, q in self.maker.items()},
        }  # fmt: skip
        manifest = Manifest.model_validate(
            {"name": f"foreign {self.seed}", "cameras": {"left": camera}, "captures": self.captures_}
        )
        return RecordingSet(manifest, self.frames_, self.spectra_, targets, source=f"foreign-{self.seed}")

    def _chart(self, light: np.ndarray) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from colour import SDS_COLOURCHECKERS
        patches = list(SDS_COLOURCHECKERS["BabelColor Average"].values())
        reflectance = [np.interp(WL, p.wavelengths, p.values) for p in patches]
        row0, col0, row1, col1 = 60, 70, self.rows - 60, self.cols - 70
        images = {}
        for c in self.qe:
            image = np.full((self.rows, self.cols), self.rate(0.18 * light, c))
            h, w = (row1 - row0) / 4, (col1 - col0) / 6
            for k, refl in enumerate(reflectance):
                i, j = divmod(k, 6)
                image[
                    round(row0 + i * h) + 3 : round(row0 + (i + 1) * h) - 3,
                    round(col0 + j * w) + 3 : round(col0 + (j + 1) * w) - 3,
                ] = self.rate(refl * light, c)
            # the lens blurs the chart too: light neighbours reach into the black patch
            f = np.hypot(np.fft.fftfreq(2 * self.rows)[:, None], np.fft.rfftfreq(2 * self.cols)[None, :])
            grid = np.linspace(0, 0.75, 150)
            h = np.interp(f, grid, self.otf(grid, 0.0, light * WL, c))
            wide = np.pad(image, [(0, self.rows), (0, self.cols)], mode="symmetric")
            image = np.fft.irfft2(np.fft.rfft2(wide) * h, wide.shape)[: self.rows, : self.cols]
            images[c] = image
        corners = [[row0, col0], [row0, col1], [row1, col1], [row1, col0]]
        self.take(
            "chart",
            images,
            self.best_exposure(images, 0.8),
            2,
            chart="ColorChecker24",
            corners=corners,
            radiance=self.spectrum("chartlight", light),
        )
