"""Light in the dark squares of patterns on a screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.capture_kinds.bernoulli import BernoulliCapture
from lab.capture_kinds.black import BlackCapture
from lab.capture_kinds.checkerboard import CheckerboardCapture
from lab.capture_kinds.white import WhiteCapture
from lab.errors import NotDetermined
from lab.observables.dataset import Dataset, held_out_of, mean_frame
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.plane_means import channel_pixels
from lab.observables.reads import BLUR, REFLECTIONS, acting
from lab.observables.surroundings import Surroundings, halo_light, harmonics
from sim.camera import CameraModel
from sim.effects.base import Effects
from sim.frame import with_reflections
from sim.point import even_share, optical_transfer, wide_contrast
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import Uniform

RADII, ANGLES = 24, 4  # nodes of frequency and orientation between which a transfer function is interpolated
FINE_CY_PER_PX = 0.01  # frequency below which the nodes are evenly spaced


def measure_screen(dataset: Dataset) -> Observable:
    """Mean level in the dark squares of a pattern on a screen, less that of the dark screen, by channel, DN.

    Only pixels at least 7 px away from lit ones count. The baseline's point spread function reaches them, which is
    predicted from the lit pixels. A veil adds a share of the frame's mean. Raises NotDetermined without white, black
    and patterned captures of one pose and exposure, or without dark squares wide enough.
    """
    recordings, side, camera, noise = dataset.recordings, dataset.side, dataset.camera, dataset.noise
    by_pose: dict[str, dict[str, list[Any]]] = {}
    shown: list[WhiteCapture | BlackCapture | CheckerboardCapture | BernoulliCapture] = [
        *recordings.captures(WhiteCapture, side), *recordings.captures(BlackCapture, side),
        *recordings.captures(CheckerboardCapture, side), *recordings.captures(BernoulliCapture, side),
    ]  # fmt: skip
    for capture in shown:
        by_pose.setdefault(capture.screen.pose, {}).setdefault(capture.kind, []).append(capture)
    points = []
    for kinds in by_pose.values():
        if "white" not in kinds or "black" not in kinds:
            continue
        levels = {k: mean_frame(recordings, kinds[k]) for k in ("white", "black")}
        exposure = kinds["white"][0].exposure_s
        if kinds["black"][0].exposure_s != exposure:
            continue
        for kind in ("checkerboard", "bernoulli"):
            patterned = kinds.get(kind, [])
            if not patterned or patterned[0].exposure_s != exposure:
                continue
            out = held_out_of(patterned, 0, 0) if len(patterned) > 1 else set()
            for part in ([c for c in patterned if c.id not in out], [c for c in patterned if c.id in out]):
                if part:
                    points += _dark_squares(
                        dataset,
                        part,
                        mean_frame(recordings, part),
                        levels["white"],
                        levels["black"],
                        part[0].id in out,
                        len(kinds["black"]),
                    )
    if not points:
        raise NotDetermined(
            "screen", "no white, black and patterned captures of one screen with dark squares wide enough"
        )
    value = np.array([p.value for p in points])
    tail, beyond = np.array([p.tail for p in points]), np.array([p.beyond for p in points])
    lift = np.array([p.lift for p in points])
    covariance = np.diag(np.array([p.std for p in points]) ** 2 + 2 * noise.jitter_dn**2)
    ids = [p.kind for p in points]
    same = np.array([[a == b for b in ids] for a in ids])
    white = np.array([p.white for p in points])
    channel = np.array([p.channel for p in points])
    # seen and held-out repeats have the dark screen's frames, and their rounding, in common
    fixed = np.array([np.hypot(p.digits, p.black_std) for p in points])
    covariance += (
        same * np.outer(tail, tail) * dataset.tail_std**2
        + np.outer(beyond, beyond)
        + np.diag(np.square(1e-4 * white))
        + same * (channel[:, None] == channel) * np.outer(fixed, fixed)
    )

    def predict(effects: Effects) -> Prediction:
        shift = halo_light([p.around for p in points], effects, camera)
        model = Uniform(camera, effects)
        if not model.is_linear:
            low = np.maximum(tail, 0.0) / noise.gain
            base = np.array([p.black for p in points]) / noise.gain
            shift = (model.response(base + low) - model.response(base)) * noise.gain - tail
        if blurring := acting(effects, BLUR):
            shift = shift + np.array([p.reach.light(blurring) - p.reach.baseline for p in points])
        if acting(effects, REFLECTIONS):
            shift = shift + np.array([_copied(p, effects, camera) for p in points])
        return Prediction(wide_contrast(camera, effects) * tail + even_share(camera, effects) * lift + shift, {})

    return Observable(
        measurement=SCREEN, reach=1e9, value=value, covariance=covariance,
        labels=tuple(Label(float(i), p.channel, p.kind, p.captures, p.held_out) for i, p in enumerate(points)),
        reads=REFLECTIONS | BLUR | {"image.veils", "signal.response"}, predict=predict,
        scale=np.array([p.white for p in points]),
    )  # fmt: skip


@dataclass(frozen=True)
class _Reach:
    """Light that reaches dark squares from lit pixels, as a sum over frequencies of the transfer function.

    The transfer function is interpolated linearly between `RADII` x `ANGLES` nodes in polar coordinates, the radii
    `FINE_CY_PER_PX` sinh(t): wide wings change it near frequency 0. Changes of the light come out within 0.1 %."""

    camera: CameraModel
    channel: str
    radiance: Spectrum | None
    fx: FloatArray  # (n,), cy/px, of the nodes
    fy: FloatArray  # (n,)
    weight: FloatArray  # (n,), DN: what a transfer function of 1 about a node lets through

    @staticmethod
    def of(
        camera: CameraModel, channel: str, radiance: Spectrum | None, fx: FloatArray, fy: FloatArray, weight: FloatArray
    ) -> _Reach:
        """Bring the `weight` (rows, cols), DN, of all frequencies `fx` (1, cols) and `fy` (rows, 1) to the nodes."""
        radius, angle = np.hypot(fx, fy), np.arctan2(fy, fx + 0.0 * fy)
        radii = FINE_CY_PER_PX * np.sinh(np.linspace(0.0, np.arcsinh(float(radius.max()) / FINE_CY_PER_PX), RADII))
        ring = np.clip(np.searchsorted(radii, radius) - 1, 0, RADII - 2)
        outwards = (radius - radii[ring]) / (radii[ring + 1] - radii[ring])
        turn = (angle / np.pi + 0.5) * ANGLES
        sector = np.floor(turn).astype(int)
        around = turn - sector
        total = np.zeros((RADII, ANGLES))
        for i, radial in ((0, 1.0 - outwards), (1, outwards)):
            for j, azimuthal in ((0, 1.0 - around), (1, around)):
                np.add.at(total, (ring + i, (sector + j) % ANGLES), weight * radial * azimuthal)
        middle = (np.arange(ANGLES) / ANGLES - 0.5) * np.pi
        x, y = (np.multiply.outer(radii, part(middle)).ravel() for part in (np.cos, np.sin))
        return _Reach(camera, channel, radiance, x, y, total.ravel())

    def light(self, effects: Effects) -> float:
        """Return the light that reaches the squares with effects on the lens's transfer function, DN."""
        otf = optical_transfer(self.camera, self.channel, self.radiance, self.fx, self.fy, effects)
        return float(self.weight @ np.real(otf))

    @cached_property
    def baseline(self) -> float:
        """Return that light without effects, DN."""
        return self.light(())


@dataclass(frozen=True)
class _DarkSquares:
    """The dark squares of one pattern in one channel; levels in DN."""

    kind: str
    channel: str
    captures: tuple[str, ...]
    held_out: bool
    value: float  # mean level less that of the dark screen
    std: float  # of `value` by shot and read noise of the pattern's repeats
    black_std: float  # the same by that of the dark screen's
    tail: float  # predicted level by the baseline's point spread function
    picture: FloatArray  # pattern less dark screen, one plane of the mosaic
    use: NDArray[np.bool_]  # mask of the dark squares' pixels in it
    around: Surroundings  # of these pixels
    reach: _Reach  # of the lit pixels' light, by the transfer function
    beyond: float  # standard deviation of `tail` by light from beyond the frame
    lift: float  # mean of the whole frame less that of the dark screen
    white: float  # mean of the lit screen less that of the dark screen
    black: float  # mean of the dark screen above the black level
    digits: float  # standard deviation of `value` by rounding


def _copied(squares: _DarkSquares, effects: Effects, camera: CameraModel) -> float:
    """Change of the level in the dark squares by reflections of the whole image, DN."""
    shown = with_reflections(camera, squares.picture, effects)
    return float(shown[squares.use].mean() - squares.picture[squares.use].mean())


def _dark_squares(
    dataset: Dataset,
    part: Sequence[Any],
    shown: FloatArray,
    white: FloatArray,
    black: FloatArray,
    held_out: bool,
    blacks: int,
) -> list[_DarkSquares]:
    """Return the dark squares of a pattern in each channel. `part`: its captures; `shown`, `white`, `black`: mean
    frames of the pattern, of the lit and of the dark screen; `blacks`: number of dark-screen captures."""
    camera, noise = dataset.camera, dataset.noise
    found = []
    step = mosaic.step(camera.cfa)
    lit_by_channel: dict[str, Any] = {}
    for channel in dataset.channels:
        row, col = mosaic.phases(camera.cfa)[channel][0]
        plane = (slice(row, None, step), slice(col, None, step))
        full = (white - black)[plane]
        share = (shown - black)[plane] / np.maximum(full, 1e-6)
        bright = full > 0.3 * np.quantile(full, 0.95)
        lit_by_channel[channel] = plane, full, np.where(bright, np.clip(share, 0.0, 1.0), 0.0), bright
    for channel, (plane, full, share, bright) in lit_by_channel.items():
        lit = share > 0.25
        away = ndimage.distance_transform_edt(~lit) * step
        # what lies beyond the frame's border may be lit
        inside = ndimage.distance_transform_edt(np.pad(bright, 1))[1:-1, 1:-1] * step
        for clear in (12.0, 9.0, 7.0):
            use = (away >= clear) & (inside >= clear)
            if use.sum() >= 60:
                break
        else:
            continue
        pad = [(0, n) for n in share.shape]
        picture = np.where((share > 0.5) & bright, full, 0.0)
        fy: FloatArray = np.fft.fftfreq(2 * share.shape[0], step)[:, None].astype(float)
        fx: FloatArray = np.fft.rfftfreq(2 * share.shape[1], step)[None, :].astype(float)
        radiance = dataset.spectrum(part[0].screen.radiance) if part[0].screen.radiance else None
        otf = np.real(optical_transfer(camera, channel, radiance, fx, fy))
        # The mean over the dark squares, by Parseval: columns of the half spectrum stand for two. Pixels above half the
        # contrast are drawn as lit: the total is right, and far away the outline doesn't matter. How far a screen goes
        # on beyond the frame's border isn't known: the tail is the mean of two cases, no light there, and the mirror
        # image
        squares = np.conj(np.fft.rfft2(np.pad(use / use.sum(), pad)))
        twice = np.full(fx.shape, 2.0)
        twice[:, [0, -1]] = 1.0
        lit_by = [
            np.asarray(np.real(np.fft.rfft2(whole) * squares) * twice / whole.size, float)
            for whole in (np.pad(picture, pad), np.pad(picture, pad, mode="symmetric"))
        ]
        ends, endless = (float(np.sum(weight * otf)) for weight in lit_by)
        reach = _Reach.of(camera, channel, radiance, fx, fy, 0.5 * (lit_by[0] + lit_by[1]))
        added = (shown - black)[plane]
        difference = added[use]
        lights = np.maximum([float(frame[plane][use].mean()) - noise.black for frame in (shown, black)], 0.0)
        variances = (noise.gain * lights + noise.read_dn**2) / np.array([len(part), blacks]) / use.sum()
        means = [float(channel_pixels(f, dataset.camera.cfa, channel).mean()) for f in (shown, black)]
        found.append(
            _DarkSquares(part[0].kind, channel, tuple(c.id for c in part), held_out, float(difference.mean()),
                         float(np.sqrt(variances[0])), float(np.sqrt(variances[1])), 0.5 * float(ends + endless),
                         added, use, Surroundings.of(harmonics(added), use), reach, 0.5 * float(endless - ends),
                         means[0] - means[1], float(full[bright].mean()),
                         float(black[plane][use].mean()) - noise.black,
                         float(np.linalg.norm(noise.rounding_std_dn(lights))))
        )  # fmt: skip
    return found


SCREEN = Measurement(
    "screen",
    title="light in the dark squares of screen patterns",
    order=400,
    axis="level",
    unit="DN",
    make=measure_screen,
    quantity="light beyond the dark screen's, DN",
    conditions="pattern",
    places="dark squares",
)
