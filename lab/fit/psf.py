"""Blur kernels from a Bernoulli pattern on a screen.

Model: blurred = kernel * sharp + noise, kernel >= 0, sum 1 (`estimate_kernel`). The quadratic form of the least squares (the
Gram matrix) is built over the region where the whole kernel sees the target, so that no border is trusted and no
periodicity assumed. What the data leave open is filled by a Gaussian process of the kernel: covariance = envelope x
stationary correlation x envelope, its strength and its length chosen by evidence, its envelope from the estimate itself. The
solution is the exact optimum on the simplex, by accelerated projected gradients and then an active-set polish. Sum 1 is part
of the problem: positivity alone inflates the sum, and to normalise afterwards is no estimate any more.

On recordings (`fit_psf`) the pattern is drawn where the checkerboard says that it is (`lab.fit.screen`), the capture is
levelled between white and black, and each channel is analysed on its own pixels of the mosaic. The kernel is solved on a grid
of half a pixel, for on one of a pixel the pattern's sharp rims have no place of their own; registration and kernel are refined
in turn. What comes out is on the sensor's pixels, as `sim.forward.kernel` defines it: element [half + i, half + j] is the
answer i px down and j px right of light spread over one pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.signal import fftconvolve

from lab.errors import NotDetermined
from lab.fit.screen import ScreenWarp, register
from lab.recording import Bernoulli, Camera, RecordingSet
from lab.results import NoiseFit, PsfKernel
from sim.camera import Cfa, Side
from sim.sensor.mosaic import phases, planes
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]

LENGTHS_PX = (0.0, 0.6, 1.0, 1.6, 2.5)  # of the prior's correlation; 0: none
STRENGTHS = (0.5, 1.0, 2.0, 4.0)  # of the prior, relative to the kernel's maximum
FAR_STD = 0.1  # of the prior of the light from beyond the support
REGISTRATION_STEPS = 3
GRID_STD = 5e-4  # of the kernel's maximum: what five taps on half pixels leave of a diffraction-limited kernel
SHIFT_STD_PX = 0.005  # of the corners' common place, beside their scatter: neighbouring squares of unequal shading
RIM_SHARE = 0.04  # of a kernel in the outermost pixels, above which the support is doubled
ROUNDS = 3  # envelope -> kernel -> envelope; more change less than 0.1 dB


@dataclass(frozen=True)
class KernelEstimate:
    """`kernel` (support, support), >= 0, sum 1, and one standard uncertainty of every value; `noise_std` of the blurred
    picture; `length_px`, `strength`: the prior that the evidence chose. `far`: share of the light from beyond the support.
    `information` and `precision` are the data's and the prior's share of the quadratic form that was solved."""

    kernel: Array
    kernel_std: Array
    covariance: Array
    noise_std: float
    length_px: float
    strength: float
    far: float
    information: Array
    precision: Array


@dataclass(frozen=True)
class Normal:
    """Normal equations of blurred = kernel * sharp: `gram` (k, k), `right` (k,), `power` = blurred . blurred, `count` samples."""

    gram: Array
    right: Array
    power: float
    count: int

    def __add__(self, other: Normal) -> Normal:
        return Normal(
            self.gram + other.gram, self.right + other.right, self.power + other.power, self.count + other.count
        )


def estimate_kernel(
    sharp: ArrayLike, blurred: ArrayLike, support: int, noise_std: float | None = None
) -> KernelEstimate:
    """The kernel that blurs `sharp` into `blurred`, both (rows, cols); `support` is odd.

    blurred[r, c] = sum_ij kernel[i, j] sharp[r - i + support // 2, c - j + support // 2] + noise, on the rows and columns at
    least support // 2 from the border. `noise_std` is taken from the residual where it isn't given. Raises `NotDetermined`
    where the picture is smaller than 2 x support or holds no structure.
    """
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    if u.shape != b.shape or u.ndim != 2:
        raise ValueError(f"sharp {u.shape} and blurred {b.shape} must be of the same two-dimensional shape")
    if support < 1 or support % 2 == 0:
        raise ValueError(f"support = {support} must be odd and positive: the kernel has a middle")
    if min(u.shape) < 2 * support:
        raise NotDetermined("psf", f"{u.shape[0]} x {u.shape[1]} px are too few for a kernel of {support} x {support}")
    return solve_kernel(normal_equations(u, b, support), support, noise_std)


def normal_equations(sharp: Array, blurred: Array, support: int) -> Normal:
    """Exact Gram matrix and right side over the region that the whole kernel sees.

    Every product of `sharp` with itself shifted is summed once over the part that all windows share and by running sums over
    the margins: O(support^2 pixels), not O(support^4 pixels).
    """
    s, h = support, support // 2
    rows, cols = sharp.shape
    tall, wide = rows - 2 * h, cols - 2 * h
    offset = float(sharp.mean())  # products of centred values: no digits lost to the mean
    u = sharp - offset
    level = float(blurred[h : rows - h, h : cols - h].mean())
    b = blurred[h : rows - h, h : cols - h] - level
    index = np.arange(s)

    def windows(product: Array) -> Array:
        """Sums over `tall` x `wide` windows that begin at every row and column 0..support-1: (support, support)."""
        by_row = np.empty((s, product.shape[1]))
        by_row[0] = product[:tall].sum(axis=0)
        by_row[1:] = by_row[0] + np.cumsum(product[tall : tall + s - 1] - product[: s - 1], axis=0)
        total = np.empty((s, s))
        total[:, 0] = by_row[:, :wide].sum(axis=1)
        total[:, 1:] = total[:, :1] + np.cumsum(by_row[:, wide : wide + s - 1] - by_row[:, : s - 1], axis=1)
        return total

    # Kernel element (i, j) sees the window that begins at (2 h - i, 2 h - j)
    gram = np.zeros((s, s, s, s))
    for di in range(s):
        for dj in range(-(s - 1) if di else 0, s):
            shifted = np.zeros_like(u)
            source = u[: rows - di, max(0, -dj) : cols - max(0, dj)]
            shifted[di:, max(0, dj) : cols - max(0, -dj)] = source
            sums = windows(u * shifted)[::-1, ::-1]  # [i, j]: window of (i, j) with that of (i + di, j + dj)
            ii, jj = np.ix_(index[: s - di], index[max(0, -dj) : s - max(0, dj)])
            part = sums[ii, jj]
            gram[ii, jj, ii + di, jj + dj] = part
            gram[ii + di, jj + dj, ii, jj] = part
    means = windows(u)[::-1, ::-1].ravel()
    right = np.empty((s, s))
    for i in range(s):
        for j in range(s):
            right[i, j] = np.vdot(u[2 * h - i : 2 * h - i + tall, 2 * h - j : 2 * h - j + wide], b)
    # Back from the centred values: sharp = u + offset, blurred = b + level, sum of b over the region 0
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    full_right = right.ravel() + level * means + offset * level * count
    return Normal(full, full_right, float(np.vdot(b, b)) + level**2 * count, count)


def solve_kernel(
    normal: Normal, support: int, noise_std: float | None = None, *, far: bool = False, rounds: int = ROUNDS
) -> KernelEstimate:
    """The kernel of given normal equations; see `estimate_kernel`.

    With `far` their last element is one of its own: light from beyond the support, which takes its share of the sum.
    """
    size, total = support * support, len(normal.right)
    if total != size + far:
        raise ValueError(f"normal equations of {total} elements don't fit a support of {support} x {support}")
    scale = float(np.trace(normal.gram)) / total
    spread = normal.power / normal.count - (normal.right.mean() ** 2 / max(scale, 1e-300)) / normal.count
    if not scale > 0.0 or not spread > 0.0:
        raise NotDetermined("psf", "the target shows no structure: put a Bernoulli pattern on the screen")
    found = on_simplex(normal.gram + 1e-9 * scale * np.eye(total), normal.right, np.full(total, 1.0 / total), 6)
    residual = max(
        normal.power - 2.0 * float(np.vdot(normal.right, found)) + float(np.vdot(found, normal.gram @ found)), 0.0
    )
    freedom = max(normal.count - int(np.count_nonzero(found > 0.0)), 1)
    noise = float(np.sqrt(residual / freedom)) if noise_std is None else float(noise_std)
    noise = max(noise, 1e-9 * float(np.sqrt(normal.power / normal.count)))
    information, weighted = normal.gram / noise**2, normal.right / noise**2

    # The evidence is the kernel's: what is beyond is integrated out
    inside, seen = information[:size, :size], weighted[:size]
    if far:
        pull = information[:size, size] / (information[size, size] + FAR_STD**-2)
        inside, seen = inside - np.outer(pull, information[:size, size]), seen - pull * weighted[size]
    precision = np.zeros_like(information)
    if far:
        precision[size, size] = FAR_STD**-2
    at = (2, 1)
    for last in range(1 - rounds, 1):
        prior, at = _by_evidence(inside, seen, found[:size].reshape(support, support), at)
        precision[:size, :size] = prior.precision()
        found = on_simplex(information + precision, weighted, found, 80 if last == 0 else 6)
    share = float(found[:size].sum())
    posterior = prior.posterior(inside) / share**2
    return KernelEstimate(
        kernel=found[:size].reshape(support, support) / share,
        kernel_std=np.sqrt(np.clip(np.diag(posterior), 0.0, None)).reshape(support, support),
        covariance=posterior,
        noise_std=noise,
        length_px=prior.length,
        strength=prior.strength,
        far=1.0 - share if far else 0.0,
        information=information,
        precision=precision,
    )


# --- recordings ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScreenPictures:
    """The captures of one pose of the screen, repeats averaged and levelled: 0 as black, 1 as white, NaN where the screen isn't.
    `first` is the first of the Bernoulli captures."""

    first: Bernoulli
    checkerboard: Array
    bernoulli: Array
    checkerboard_target: NDArray[np.uint8]
    bernoulli_target: NDArray[np.uint8]


@dataclass(frozen=True)
class ScreenKernel:
    """Kernel of one channel from one pose: on the sensor's pixels, sum 1, with its covariance over all elements, and as it was
    solved, on half pixels (`fine`). `far` is the share of the light that lands beyond the kernel's support."""

    channel: str
    kernel: Array
    kernel_std: Array
    covariance: Array
    fine: KernelEstimate
    far: float
    corner_rms_px: float
    centre_px: tuple[float, float]  # (row, col) of the samples' middle

    def predict(self, fine_kernel: Array) -> Array:
        """Kernel on the sensor's pixels that this estimator reports, at this very place and noise-free, for a predicted one.

        `fine_kernel` is on the grid of `fine.kernel`: `sim.forward.kernel(..., support=len(fine.kernel), oversample=2)`.
        """
        fine = self.fine
        size = fine.kernel.size
        data = fine.information[:, :size] @ (np.asarray(fine_kernel, dtype=float).ravel() * (1.0 - self.far))
        data = data + fine.information[:, size] * self.far
        found = on_simplex(fine.information + fine.precision, data, np.append(fine.kernel.ravel(), self.far))
        return _on_pixels(found[:size].reshape(fine.kernel.shape))


def screen_pictures(recordings: RecordingSet, side: Side) -> list[ScreenPictures]:
    """For every pose and Bernoulli target of `side`: its captures, averaged and levelled. A pose that lacks one of the four
    kinds is left out; raises `NotDetermined` where that leaves none."""
    shown: dict[str, dict[tuple[str, str], list[Any]]] = {}
    for kind in ("white", "black", "checkerboard", "bernoulli"):
        for capture in recordings.captures(side=side):
            if capture.kind == kind:
                shown.setdefault(capture.screen.pose, {}).setdefault((kind, getattr(capture, "target", "")), []).append(
                    capture
                )
    if not any(kind == "bernoulli" for kinds in shown.values() for kind, _ in kinds):
        raise NotDetermined("psf", "no bernoulli captures")
    found, reason = [], ""
    for pose, kinds in shown.items():
        present = {kind for kind, _ in kinds}
        if "bernoulli" not in present:
            continue
        missing = [kind for kind in ("white", "black", "checkerboard") if kind not in present]
        if missing:
            reason = f"pose {pose} lacks a {' and a '.join(missing)} capture: take it before the screen moves"
            continue
        boards = next(key for key in kinds if key[0] == "checkerboard")
        for key in [key for key in kinds if key[0] == "bernoulli"]:
            try:
                white, black, board, pattern = (
                    _mean_rate(recordings, kinds[name]) for name in (("white", ""), ("black", ""), boards, key)
                )
            except NotDetermined as refused:
                reason = refused.reason
                continue
            contrast = white - black
            for plane in planes(contrast, recordings.camera(side).cfa).values():
                plane[plane < 0.2 * np.quantile(plane, 0.98)] = np.nan  # where the screen isn't
            found.append(
                ScreenPictures(
                    first=kinds[key][0],
                    checkerboard=(board - black) / contrast,
                    bernoulli=(pattern - black) / contrast,
                    checkerboard_target=recordings.target(boards[1]),
                    bernoulli_target=recordings.target(key[1]),
                )
            )
    if not found:
        raise NotDetermined("psf", reason)
    return found


def _mean_rate(recordings: RecordingSet, captures: Sequence[Any]) -> Array:
    """Mean of the frames above black, per second of exposure; refuses saturated ones."""
    camera = recordings.camera(captures[0].side)
    total = np.zeros((camera.rows, camera.cols))
    for capture in captures:
        frame = recordings.frame(capture)
        saturated = float(np.mean(frame >= camera.saturation_dn))
        if saturated > 0.001:
            raise NotDetermined(
                "psf", f"{capture.id}: {100 * saturated:.1f} % of the frame is saturated; expose it shorter"
            )
        total += (frame.astype(float) - (camera.black_level_dn or 0.0)) / max(capture.exposure_s, 1e-12)
    return total / len(captures)


def measure_kernels(pictures: ScreenPictures, cfa: Cfa, support_px: int = 9) -> dict[str, ScreenKernel]:
    """Kernels of all channels of one pose, `support_px` (odd) wide; doubled once where a kernel doesn't fit in.

    The registration from the corners is refined with the kernel, all but a common shift, by Gauss-Newton on the
    residual: first on the green (or only) channel, then on each.
    """
    cell = pictures.first.screen.cell_camera_px
    warp = register(
        pictures.checkerboard, pictures.bernoulli, pictures.checkerboard_target, pictures.bernoulli_target, cell
    )
    places = phases(cfa)
    reference = "Y" if cfa == "MONO" else "G"
    found: dict[str, ScreenKernel] = {}
    size = support_px
    for channel in (reference, *(name for name in places if name != reference)):
        for _ in range(REGISTRATION_STEPS if channel == reference else 1):
            drawn = _Drawn.of(pictures, warp, places[channel], cfa, size)
            estimate = solve_kernel(drawn.normal(), drawn.support, far=True, rounds=1)
            if size == support_px and _rim_share(estimate.kernel) > RIM_SHARE:
                size = 2 * support_px - 1
                continue
            warp = drawn.refined(estimate)
        drawn = _Drawn.of(pictures, warp, places[channel], cfa, size)
        found[channel] = drawn.described(channel, solve_kernel(drawn.normal(), drawn.support, far=True))
    return {channel: found[channel] for channel in places}


def fit_psf(recordings: RecordingSet, side: Side, noise: NoiseFit | None = None) -> tuple[PsfKernel, ...]:
    """One kernel for every pose of the screen, Bernoulli target and channel of `side`.

    The noise is what the kernel leaves of the levelled picture; `noise` isn't needed for it. `field_mm` is the middle of the
    pattern from the middle of the frame. Raises `NotDetermined` where captures are missing or no pose can be registered.
    """
    del noise  # the residual says it better: it holds the photo response non-uniformity of all four captures too
    camera = recordings.camera(side)
    kernels, reason = [], ""
    for pictures in screen_pictures(recordings, side):
        try:
            measured = measure_kernels(pictures, camera.cfa)
        except NotDetermined as refused:
            reason = f"{pictures.first.id}: {refused.reason}"
            continue
        for channel, found in measured.items():
            kernels.append(
                PsfKernel(
                    capture=pictures.first.id,
                    channel=channel,
                    field_mm=_field_mm(camera, found.centre_px),
                    sample_pitch_px=1.0,
                    psf=tuple(tuple(float(v) for v in values) for values in found.kernel),
                    psf_std=tuple(tuple(float(v) for v in values) for values in found.kernel_std),
                )
            )
    if not kernels:
        raise NotDetermined("psf", reason)
    return tuple(kernels)


def _field_mm(camera: Camera, at_px: tuple[float, float]) -> tuple[float, float] | None:
    """Of a place in the frame, from its middle, at the sensor."""
    if camera.pixel_pitch_um is None:
        return None
    pitch_mm = 1e-3 * camera.pixel_pitch_um
    return pitch_mm * (at_px[0] - (camera.rows - 1) / 2.0), pitch_mm * (at_px[1] - (camera.cols - 1) / 2.0)


def _rim_share(kernel: Array) -> float:
    """Share of the kernel in its outermost pixel (two half pixels)."""
    return float(1.0 - kernel[2:-2, 2:-2].sum() / kernel.sum())


def _on_pixels(fine: Array) -> Array:
    """From half pixels to pixels, sum 1."""
    matrix = _pixel_matrix(len(fine))
    kernel = matrix @ fine @ matrix.T
    return np.asarray(kernel / kernel.sum())


def _pixel_matrix(size: int) -> Array:
    """One axis: light over a whole pixel is light over two half ones, a quarter pixel to either side: cos(pi f / 2)."""
    half = (size // 2 - 1) // 2
    taps = _taps(lambda f: np.cos(0.5 * np.pi * f), 0.8)
    matrix = np.zeros((2 * half + 1, size + 4))
    for row in range(2 * half + 1):
        middle = size // 2 + 2 + 2 * (row - half)
        matrix[row, middle - 2 : middle + 3] = taps
    return matrix[:, 2:-2]


def _taps(response: Callable[[Array], Array], highest_cy_per_px: float) -> Array:
    """Five symmetric taps on half pixels with a given response, 1 at 0, by least squares up to `highest_cy_per_px`."""
    frequency = np.linspace(0.0, highest_cy_per_px, 61)
    terms = np.column_stack([np.ones_like(frequency), 2 * np.cos(np.pi * frequency), 2 * np.cos(2 * np.pi * frequency)])
    weight = np.where(frequency == 0.0, 1e3, 1.0)
    taps = np.linalg.lstsq(terms * weight[:, None], weight * response(frequency), rcond=None)[0]
    return np.asarray(taps[[2, 1, 0, 1, 2]] / (taps[0] + 2 * taps[1] + 2 * taps[2]))


@dataclass(frozen=True)
class _Drawn:
    """The target drawn on half pixels through a warp, and one channel's samples on it."""

    warp: ScreenWarp
    picture: Array  # drawn, (2 rows, 2 cols)
    around: Array  # its mean over the surroundings: what light from beyond the support sees
    row: NDArray[np.int64]  # of the samples, px
    col: NDArray[np.int64]
    value: Array
    support: int  # half pixels

    @staticmethod
    def of(
        pictures: ScreenPictures, warp: ScreenWarp, places: Sequence[tuple[int, int]], cfa: Cfa, support_px: int
    ) -> _Drawn:
        rows, cols = pictures.bernoulli.shape
        target = pictures.bernoulli_target.astype(float)
        # The map is smooth: worked out on a coarse grid, interpolated by cubic splines
        y, x = np.arange(-8.0, rows + 16.0, 8.0), np.arange(-8.0, cols + 16.0, 8.0)
        at = warp.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        fine_y, fine_x = np.arange(2 * rows) / 2.0, np.arange(2 * cols) / 2.0
        cell_x, cell_y = (RectBivariateSpline(y, x, at[:, :, k])(fine_y, fine_x) for k in (0, 1))
        picture = _area_drawn(target, cell_x, cell_y)
        # The squares of drawing and of the kernel's grid, half a pixel each, are taken out again
        taps = _taps(lambda f: np.sinc(0.5 * f) ** -2, 0.6)
        for axis in (0, 1):
            picture = ndimage.correlate1d(picture, taps, axis=axis, mode="nearest")
        around = ndimage.gaussian_filter(picture, 2.0 * support_px, mode="nearest", truncate=3.0)

        step = period(cfa)
        coarse = np.gradient(at[:, :, 0])
        margin = (support_px / 2.0 + 2.0) * float(np.hypot(coarse[0].mean(), coarse[1].mean())) / 8.0  # cells
        inside = (
            (cell_x > margin)
            & (cell_x < target.shape[1] - margin)
            & (cell_y > margin)
            & (cell_y < target.shape[0] - margin)
        )
        usable = inside[::2, ::2] & np.isfinite(pictures.bernoulli)
        usable[: support_px + 1] = usable[-support_px - 1 :] = False
        usable[:, : support_px + 1] = usable[:, -support_px - 1 :] = False
        mine = np.zeros_like(usable)
        for row0, col0 in places:
            mine[row0::step, col0::step] = True
        row, col = np.nonzero(usable & mine)
        if len(row) < 8 * (2 * support_px + 1) ** 2:
            raise NotDetermined(
                "psf", f"only {len(row)} pixels of the channel see the pattern: let it fill more of the frame"
            )
        return _Drawn(warp, picture, around, row, col, pictures.bernoulli[row, col], 2 * support_px + 1)

    def normal(self) -> Normal:
        """Normal equations of the kernel's elements and, last, of the light from beyond."""
        s, h = self.support, self.support // 2
        size = s * s + 1
        gram, right = np.zeros((size, size)), np.zeros(size)
        windows = np.lib.stride_tricks.sliding_window_view(self.picture, (s, s))
        for start in range(0, len(self.row), 4096):
            part = slice(start, start + 4096)
            row, col, value = 2 * self.row[part], 2 * self.col[part], self.value[part]
            design = np.empty((len(row), size))
            design[:, :-1] = windows[row - h, col - h][:, ::-1, ::-1].reshape(len(row), -1)
            design[:, -1] = self.around[row, col]
            gram += design.T @ design
            right += value @ design
        return Normal(gram, right, float(self.value @ self.value), len(self.row))

    def blurred(self, estimate: KernelEstimate) -> Array:
        """The picture through the kernel, on half pixels."""
        return np.asarray(
            (1.0 - estimate.far) * fftconvolve(self.picture, estimate.kernel, mode="same") + estimate.far * self.around
        )

    def refined(self, estimate: KernelEstimate) -> ScreenWarp:
        """One Gauss-Newton step of the displacement, all but a common shift, which is the kernel's to say."""
        blurred = self.blurred(estimate)
        down, across = (np.gradient(blurred, 0.5, axis=axis)[2 * self.row, 2 * self.col] for axis in (0, 1))
        residual = self.value - blurred[2 * self.row, 2 * self.col]
        terms = self.warp.basis(np.column_stack([self.col, self.row]).astype(float))[1:]
        mean = terms.mean(axis=1)
        terms = terms - mean[:, None]
        columns = np.concatenate([across * terms, down * terms])
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2))
        step = np.linalg.lstsq((columns * inlier) @ columns.T, (columns * inlier) @ residual, rcond=1e-10)[0]
        step = step.reshape(2, -1)
        return self.warp.displaced(np.column_stack([-step @ mean, step]))

    def described(self, channel: str, estimate: KernelEstimate) -> ScreenKernel:
        matrix = _pixel_matrix(self.support)
        pixels = np.kron(matrix, matrix)
        raw = pixels @ estimate.kernel.ravel()
        total = raw.sum()
        slopes = pixels / total - np.outer(raw, pixels.sum(axis=0)) / total**2
        shape = (len(matrix), len(matrix))
        # Where the pattern lies, as a whole, is the corners' word: an error there shifts the kernel
        shifts = [
            np.gradient(np.pad((raw / total).reshape(shape), 1), axis=axis)[1:-1, 1:-1].ravel() for axis in (0, 1)
        ]
        shift_std = float(np.hypot(self.warp.corner_std_px, SHIFT_STD_PX))
        covariance = slopes @ estimate.covariance @ slopes.T + shift_std**2 * sum(np.outer(v, v) for v in shifts)
        covariance = covariance + (GRID_STD * raw.max() / total) ** 2 * np.eye(len(raw))
        return ScreenKernel(
            channel=channel,
            kernel=(raw / total).reshape(shape),
            kernel_std=np.sqrt(np.clip(np.diag(covariance), 0.0, None)).reshape(shape),
            covariance=covariance,
            fine=estimate,
            far=estimate.far,
            corner_rms_px=self.warp.corner_rms_px,
            centre_px=(float(self.row.mean()), float(self.col.mean())),
        )


def _area_drawn(target: Array, cell_x: Array, cell_y: Array) -> Array:
    """Mean of the pattern over a half pixel around points at `cell_x`, `cell_y` (cells); dark outside. The square is taken as
    aligned with the cells: its turn counts in second order only."""
    rows, cols = target.shape
    padded = np.pad(target, 1)

    def neighbours(cell: Array, limit: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        by_row, by_col = np.gradient(cell[::16, ::16])
        spread = float(np.abs(by_row).mean() + np.abs(by_col).mean()) / 16.0
        low, high = np.floor(cell - 0.5 * spread), np.floor(cell + 0.5 * spread)
        share = np.where(high > low, (cell + 0.5 * spread - high) / spread, 0.0)
        return (np.clip(low, -1, limit) + 1).astype(int), (np.clip(high, -1, limit) + 1).astype(int), share

    left, right, across = neighbours(cell_x, cols)
    top, bottom, down = neighbours(cell_y, rows)
    upper = padded[top, left] * (1.0 - across) + padded[top, right] * across
    lower = padded[bottom, left] * (1.0 - across) + padded[bottom, right] * across
    return np.asarray(upper * (1.0 - down) + lower * down)


# --- the prior -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Prior:
    """k ~ N(0, strength^2 E C E): E the envelope, C a Gaussian correlation of `length` px with a share of 1e-4 of white.

    C is separable: its eigenvectors are products of those of one axis, and are applied axis by axis.
    """

    envelope: Array  # (support^2,), 1 at most
    length: float
    strength: float

    @property
    def support(self) -> int:
        return int(np.sqrt(len(self.envelope)))

    def _eigen(self) -> tuple[Array, Array]:
        """Eigenvalues (support^2,) and the eigenvectors of one axis (support, support)."""
        x = np.arange(self.support)
        if self.length <= 0.0:
            return np.ones(self.support**2), np.eye(self.support)
        power, waves = np.linalg.eigh(np.exp(-0.5 * ((x[:, None] - x) / self.length) ** 2))
        return np.clip(np.kron(power, power), 0.0, None) + 1e-4, waves

    def root(self) -> Array:
        """R with covariance R R^T."""
        power, waves = self._eigen()
        return np.asarray(self.strength * self.envelope[:, None] * np.kron(waves, waves) * np.sqrt(power))

    def precision(self) -> Array:
        """Inverse of the covariance."""
        power, waves = self._eigen()
        inverse = _along_axes(waves.T, np.diag(1.0 / power))
        envelope = self.strength * self.envelope
        return np.asarray(inverse / np.outer(envelope, envelope))

    def seen(self, information: Array) -> Array:
        """R^T information R."""
        power, waves = self._eigen()
        envelope = self.strength * self.envelope
        inner = _along_axes(waves, information * np.outer(envelope, envelope))
        return np.asarray(inner * np.sqrt(np.outer(power, power)))

    def evidence(self, information: Array, weighted: Array) -> float:
        """Log of the probability of the data under the prior, but for a constant."""
        inner = self.seen(information)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)
        power, waves = self._eigen()
        scaled = (self.strength * self.envelope * weighted).reshape(self.support, self.support)
        right = (waves.T @ scaled @ waves).ravel() * np.sqrt(power)
        half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
        return float(0.5 * half @ half - np.log(np.diag(factor)).sum())

    def posterior(self, information: Array) -> Array:
        """Covariance of the kernel, given the data and that the sum is 1."""
        inner = self.seen(information)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, check_finite=False)
        half = linalg.solve_triangular(factor, self.root().T, lower=True, check_finite=False)
        covariance = half.T @ half
        share = covariance.sum(axis=1)
        return np.asarray(covariance - np.outer(share, share) / share.sum())


def _along_axes(waves: Array, matrix: Array) -> Array:
    """(W x W)^T matrix (W x W)."""
    s = len(waves)
    out = np.tensordot(waves, matrix.reshape(s, s, s * s), axes=(0, 0))  # (s', s, k)
    out = np.tensordot(waves, out, axes=(0, 1)).transpose(1, 0, 2).reshape(s * s, s, s)
    out = np.tensordot(out, waves, axes=(1, 0))  # (k', s, s')
    return np.tensordot(out, waves, axes=(1, 0)).reshape(s * s, s * s)


def _envelope(kernel: Array) -> Array:
    """Local mean of the kernel, over about a pixel, with a floor; the largest is 1."""
    local = ndimage.gaussian_filter(kernel, 0.6, mode="constant")
    return np.asarray(np.maximum(local / local.max(), 5e-4).ravel())


def _by_evidence(
    information: Array, weighted: Array, kernel: Array, near: tuple[int, int]
) -> tuple[_Prior, tuple[int, int]]:
    """The prior's length and strength by evidence, uphill on their grid from `near`; the prior and where it stands."""
    envelope, top = _envelope(kernel), float(kernel.max())
    tried: dict[tuple[int, int], tuple[float, _Prior]] = {}

    def value(at: tuple[int, int]) -> float:
        if not (0 <= at[0] < len(LENGTHS_PX) and 0 <= at[1] < len(STRENGTHS)):
            return -np.inf
        if at not in tried:
            prior = _Prior(envelope, LENGTHS_PX[at[0]], STRENGTHS[at[1]] * top)
            tried[at] = prior.evidence(information, weighted), prior
        return tried[at][0]

    at = near
    while True:
        around = [(at[0] + i, at[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        best = max(around, key=value)
        if value(best) <= value(at):
            return tried[at][1], at
        at = best


# --- the simplex -----------------------------------------------------------------------------------------------------------


def _project_on_simplex(x: Array) -> Array:
    """Nearest point with x >= 0, sum 1."""
    ordered = np.sort(x)[::-1]
    excess = (np.cumsum(ordered) - 1.0) / np.arange(1, len(x) + 1)
    return np.asarray(np.maximum(x - excess[np.flatnonzero(ordered > excess)[-1]], 0.0))


def on_simplex(quadratic: Array, linear: Array, start: Array, solves: int = 80) -> Array:
    """argmin 1/2 x Q x - c x over x >= 0, sum x = 1: projected gradients with momentum, then an exact active-set polish.

    `solves` limits the polish, each of which costs one factorisation; it ends by itself at the optimum.
    """
    scale = np.sqrt(np.diag(quadratic).mean())
    q, c = quadratic / scale**2, linear / scale**2
    vector = np.ones(len(c)) / np.sqrt(len(c))
    for _ in range(12):
        vector = q @ vector
        vector /= np.linalg.norm(vector)
    step = 1.0 / (1.05 * float(np.vdot(vector, q @ vector)))
    x = _project_on_simplex(start)
    y, momentum = x, 1.0
    for _ in range(150):
        new = _project_on_simplex(y - step * (q @ y - c))
        if (y - new) @ (new - x) > 0.0:  # restart where the momentum points uphill
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        y = new + (momentum - 1.0) / following * (new - x)
        done = np.abs(new - x).max() < 1e-9 * new.max()
        x, momentum = new, following
        if done:
            break
    return _polished(q, c, x, solves)


def _polished(q: Array, c: Array, x: Array, solves: int) -> Array:
    """Exact optimum from a nearby point: solve on the support, step back to the border, admit what the gradient wants."""
    free = x > 0.0
    for _ in range(solves):
        at = np.flatnonzero(free)
        factor = linalg.cho_factor(q[np.ix_(at, at)], check_finite=False)
        both = linalg.cho_solve(factor, np.column_stack([c[at], np.ones(len(at))]), check_finite=False)
        multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
        solution = both[:, 0] + multiplier * both[:, 1]
        if solution.min() < 0.0:
            free[at[solution < 0.0]] = False
            continue
        x = np.zeros_like(x)
        x[at] = solution
        pull = c - q @ x + multiplier
        wanted = ~free & (pull > 1e-10 * np.abs(c).max())
        if not wanted.any():
            break
        # few at a time, lest they chase each other
        most = np.argsort(np.where(wanted, pull, -np.inf))[-max(1, int(wanted.sum()) // 3) :]
        free[most[wanted[most]]] = True
    return x / x.sum()
