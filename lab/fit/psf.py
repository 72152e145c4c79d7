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
from dataclasses import dataclass, replace
from typing import Any, overload

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, ndimage, special
from scipy.interpolate import RectBivariateSpline

from lab.errors import NotDetermined
from lab.fit.screen import MATCH, ScreenWarp, busiest_quadrilateral, register
from lab.formats.recording_set import Bernoulli, Camera, RecordingSet
from lab.formats.results import NoiseFit, PsfKernel, PsfSymmetry
from sim.camera import Cfa, Side
from sim.sensor.mosaic import phases, planes
from sim.sensor.mosaic import step as period

Array = NDArray[np.floating[Any]]

LENGTHS_PX = (0.0, 0.6, 1.0, 1.6, 2.5)  # of the prior's correlation; 0: none
STRENGTHS = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the prior, relative to the kernel's maximum
FAR_STD = 0.1  # of the prior of the light from beyond the support
REGISTRATION_STEPS = 3
GRID_PX = 11.0  # of the grid on which the place of a drawn pattern is refined
NODE_STD_PX = 0.5  # how far its nodes may move
NODE_BENDS_PX = (0.02, 0.1, 0.5)  # second differences between its nodes, by evidence
LEAST_FIELD_EVIDENCE = 3.0  # logarithm, for a displacement against none
BRIEF_SOLVES, MOST_SOLVES = 4, 80  # of the polish: of a kernel that is not the last one, and of one that is
GRID_STD = 5e-4  # of the kernel's maximum: what five taps on half pixels leave of a diffraction-limited kernel
SHIFT_STD_PX = 0.005  # of the corners' common place, beside their scatter: neighbouring squares of unequal shading
MOMENT_WINDOW_PX = 2.0  # of the moments that tell whether kernels over the field are symmetric
RIM_SHARE = 0.04  # of a kernel in the outermost pixels, above which the support is doubled
PHOTO_MARGIN_PX = 16
PHOTO_ROUNDS = 4  # kernel and registration in turn
ALIGN_STEPS = 4  # a blur, of the registration by the pattern alone
PATIENCE = 3  # exchanges that don't gain
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
    sharp: ArrayLike,
    blurred: ArrayLike,
    support: int,
    noise_std: float | None = None,
    *,
    register: bool = True,
) -> KernelEstimate:
    """The kernel that blurs `sharp` into `blurred`, both (rows, cols); `support` is odd.

    blurred[r, c] = sum_ij kernel[i, j] sharp[r - i + support // 2, c - j + support // 2] + noise, on the rows and columns at
    least support // 2 from the border. `noise_std` is taken from the residual where it isn't given. With `register`, where the
    residual shows that `sharp` was drawn a little off its place (`displacement`), the places are refined with the kernel: all
    but a common shift, which is the kernel's. Raises `NotDetermined` where the picture is smaller than 2 x support, isn't
    finite or holds no structure, or where `sharp` explains nothing of `blurred`.
    """
    u, b = np.asarray(sharp, dtype=float), np.asarray(blurred, dtype=float)
    if u.shape != b.shape or u.ndim != 2:
        raise ValueError(f"sharp {u.shape} and blurred {b.shape} must be of the same two-dimensional shape")
    if support != int(support) or support < 1 or support % 2 == 0:
        raise ValueError(f"support = {support} must be a whole number, odd and positive: the kernel has a middle")
    if noise_std is not None and not 0.0 <= noise_std < np.inf:
        raise ValueError(f"noise_std = {noise_std} must be finite and not negative")
    if min(u.shape) < 2 * support:
        raise NotDetermined("psf", f"{u.shape[0]} x {u.shape[1]} px are too few for a kernel of {support} x {support}")
    for name, picture in (("sharp", u), ("blurred", b)):
        if not np.isfinite(picture).all():
            raise NotDetermined(
                "psf", f"{int((~np.isfinite(picture)).sum())} pixels of the {name} picture aren't finite"
            )
    from scipy.signal import fftconvolve  # here: the library takes a while to load

    normal = normal_equations(u, b, support)
    found = solve_kernel(normal, support, noise_std, rounds=1, solves=BRIEF_SOLVES)
    inner = np.s_[support // 2 : u.shape[0] - support // 2, support // 2 : u.shape[1] - support // 2]
    kernel, predicted = found.kernel, fftconvolve(u, found.kernel, mode="same")
    _refuse_unrelated(predicted[inner], b[inner])
    field = displacement(predicted, b, support // 2) if register else None
    if field is not None:
        # Gauss-Newton: the derivatives by the kernel are the target's own values where the field says that they lie
        carried = displaced(u, field)
        normal = normal_equations(carried, b, support)
        for step in range(REGISTRATION_STEPS):
            moved = displaced(predicted, field)
            linear = b - moved + fftconvolve(carried, kernel, mode="same")
            right = normal_equations_right(carried, linear, support)
            normal = replace(normal, right=right[0], power=right[1])
            if step < REGISTRATION_STEPS - 1:
                noise2 = float(np.mean((b - moved)[inner] ** 2))
                elements = on_simplex(
                    normal.gram + noise2 * found.precision, normal.right, kernel.ravel(), BRIEF_SOLVES
                )
                kernel = elements.reshape(support, support)
                predicted = fftconvolve(u, kernel, mode="same")
                field = displacement(predicted, b, support // 2, field)
        found = replace(found, kernel=kernel)
    return solve_kernel(normal, support, noise_std, begin=found, rounds=ROUNDS - 1)


def _refuse_unrelated(predicted: Array, seen: Array) -> None:
    """A pattern that isn't the one in the picture explains nothing of it, whatever the kernel: never a kernel without a basis."""
    if not seen.std() > 0.0:
        raise NotDetermined(
            "psf", f"the blurred picture is uniform at {seen.flat[0]:g}: is the target lit, or is it saturated?"
        )
    agreement = float(np.corrcoef(predicted.ravel(), seen.ravel())[0, 1]) if predicted.std() > 0.0 else 0.0
    if not agreement**2 > 0.25:
        raise NotDetermined(
            "psf",
            f"the sharp picture explains {100 * max(agreement, 0.0) ** 2:.0f} % of the blurred one: is it that pattern?",
        )
    contrast = agreement * float(seen.std() / predicted.std())
    if not 0.5 < contrast < 2.0:
        raise NotDetermined(
            "psf",
            f"the blurred picture has {contrast:.2g} times the contrast of the sharp one: level it between white and black, or widen the support",
        )
    for name, end in (("lowest", seen.min()), ("highest", seen.max())):
        standing = seen == end
        share = float(standing.mean())
        # of pixels that stand still although the pattern says that they differ
        if share > 0.02 and float(predicted[standing].std()) > 0.1 * float(predicted.std()):
            raise NotDetermined(
                "psf",
                f"{100 * share:.0f} % of the blurred picture stand at its {name} value, {end:g}: it is clipped, expose it anew",
            )


def displaced(picture: Array, field: Array) -> Array:
    """`picture` read off at every pixel's place plus `field` (2, rows, cols), px, by splines of order 5."""
    rows, cols = np.indices(picture.shape, dtype=float)
    return np.asarray(ndimage.map_coordinates(picture, [rows + field[0], cols + field[1]], order=5, mode="nearest"))


@overload
def displacement(predicted: Array, seen: Array, border: int, start: Array) -> Array: ...
@overload
def displacement(predicted: Array, seen: Array, border: int) -> Array | None: ...
def displacement(predicted: Array, seen: Array, border: int, start: Array | None = None) -> Array | None:
    """Field (2, rows, cols) by which `predicted` has to be read off elsewhere to be `seen`, px: bilinear between the nodes of a
    grid of about `GRID_PX`, its mean taken out. None where the evidence is against one, but where `start` says that there is one.

    Gauss-Newton on the residual. The nodes move by `NODE_STD_PX` at most, and bend the grid by as much as the evidence says.
    """
    inner = np.s_[border : seen.shape[0] - border, border : seen.shape[1] - border]
    hats = [_hats(n, max(2, round(n / GRID_PX) + 1)) for n in seen[inner].shape]
    shape = hats[0].shape[1], hats[1].shape[1]
    nodes = shape[0] * shape[1]
    field, at = np.zeros((2, *seen.shape)), np.zeros(2 * nodes)
    if start is not None:
        field = start
        at = np.concatenate([(_pinv(hats[0]) @ part[inner] @ _pinv(hats[1]).T).ravel() for part in start])
    one = [_roughness(shape, bend) + np.eye(nodes) / NODE_STD_PX**2 for bend in NODE_BENDS_PX]
    precision = one[0]
    for turn in range(2):
        moved = displaced(predicted, field)
        residual = (seen - moved)[inner]
        noise2 = float(np.mean(residual**2))
        slopes = [np.gradient(moved, axis=axis)[inner] for axis in (0, 1)]
        gram = np.block([[_hat_gram(hats, a * b) for b in slopes] for a in slopes]) / noise2
        right = np.concatenate([(hats[0].T @ (a * residual) @ hats[1]).ravel() for a in slopes]) / noise2
        if turn == 0:
            evidence = [_field_evidence(gram, right + gram @ at, p) for p in one]
            if start is None and max(evidence) < LEAST_FIELD_EVIDENCE:
                return None
            precision = linalg.block_diag(*[one[int(np.argmax(evidence))]] * 2)
        factor = linalg.cho_factor(gram + precision, lower=True, check_finite=False)
        at = at + linalg.cho_solve(factor, right - precision @ at, check_finite=False)
        parts = [hats[0] @ part.reshape(shape) @ hats[1].T for part in np.split(at, 2)]
        field = np.stack([np.pad(part - part.mean(), border, mode="edge") for part in parts])
    return field


def _pinv(hats: Array) -> Array:
    return np.asarray(np.linalg.pinv(hats))


def _roughness(shape: tuple[int, int], bend_px: float) -> Array:
    """Precision of a grid's nodes whose second differences, along both axes and across them, are about `bend_px`."""
    down, across = (np.eye(n) for n in shape)
    bends = [np.kron(np.diff(down, 2, axis=0), across), np.kron(down, np.diff(across, 2, axis=0))]
    bends.append(np.kron(np.diff(down, axis=0), np.diff(across, axis=0)))
    return np.asarray(sum(b.T @ b for b in bends) / bend_px**2)


def _field_evidence(gram: Array, right: Array, precision: Array) -> float:
    """Logarithm of the evidence for a displacement of given precision (of one axis), over that for none."""
    factor = linalg.cholesky(gram + linalg.block_diag(precision, precision), lower=True, check_finite=False)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    prior = linalg.cholesky(precision, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum() + 2.0 * np.log(np.diag(prior)).sum())


def _hats(count: int, nodes: int) -> Array:
    """(count, nodes): linear interpolation between evenly spread nodes."""
    at = np.linspace(0.0, nodes - 1.0, count)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(nodes)), 0.0, None)


def _hat_gram(hats: Sequence[Array], weight: Array) -> Array:
    """Products of all nodes' hats under a weight (rows, cols): (nodes, nodes)."""
    down, across = hats
    # by rows first: products of two hats along the columns, weighted
    pairs = np.einsum("ri,rj->rij", down, down).reshape(len(down), -1)  # (rows, a a')
    half = pairs.T @ weight  # (a a', cols)
    full = half @ np.einsum("ci,cj->cij", across, across).reshape(len(across), -1)  # (a a', b b')
    a, b = down.shape[1], across.shape[1]
    return np.asarray(full.reshape(a, a, b, b).transpose(0, 2, 1, 3).reshape(a * b, a * b))


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
    # Back from the centred values: sharp = u + offset
    count = tall * wide
    full = gram.reshape(s * s, s * s) + offset * (means[:, None] + means) + offset**2 * count
    return Normal(full, *normal_equations_right(sharp, blurred, support), count)


def normal_equations_right(sharp: Array, blurred: Array, support: int) -> tuple[Array, float]:
    """The right side alone, (support^2,), and the power of `blurred`: what changes with it."""
    s, h = support, support // 2
    tall, wide = sharp.shape[0] - 2 * h, sharp.shape[1] - 2 * h
    seen = blurred[h : h + tall, h : h + wide]
    offset, level = float(sharp.mean()), float(seen.mean())
    u, b = sharp - offset, seen - level
    right = np.empty((s, s))
    for i in range(s):
        for j in range(s):
            part = u[2 * h - i : 2 * h - i + tall, 2 * h - j : 2 * h - j + wide]
            right[i, j] = np.vdot(part, b) + level * part.sum()
    # blurred = b + level, sum of b over the region 0
    return right.ravel() + offset * level * tall * wide, float(np.vdot(b, b)) + level**2 * tall * wide


def solve_kernel(
    normal: Normal,
    support: int,
    noise_std: float | None = None,
    *,
    far: bool = False,
    rounds: int = ROUNDS,
    like: KernelEstimate | None = None,
    begin: KernelEstimate | None = None,
    solves: int = MOST_SOLVES,
) -> KernelEstimate:
    """The kernel of given normal equations; see `estimate_kernel`.

    With `far` their last element is one of its own: light from beyond the support, which takes its share of the sum. The prior
    is chosen by evidence, or it is that of the estimate `like`, with its noise. `begin`: a kernel close by, from which the search
    for envelope and prior begins.
    """
    size, total = support * support, len(normal.right)
    if total != size + far:
        raise ValueError(f"normal equations of {total} elements don't fit a support of {support} x {support}")
    scale = float(np.trace(normal.gram)) / total
    spread = normal.power / normal.count - (normal.right.mean() ** 2 / max(scale, 1e-300)) / normal.count
    if not scale > 0.0 or not spread > 0.0:
        raise NotDetermined("psf", "the target shows no structure: put a Bernoulli pattern on the screen")
    known = like or begin
    if known is None:
        start = np.full(total, 1.0 / total)
        found = on_simplex(normal.gram + 1e-9 * scale * np.eye(total), normal.right, start, 6)
    else:
        found = np.append(known.kernel.ravel() * (1.0 - known.far), [known.far] * far)
    residual = max(
        normal.power - 2.0 * float(np.vdot(normal.right, found)) + float(np.vdot(found, normal.gram @ found)), 0.0
    )
    freedom = max(normal.count - int(np.count_nonzero(found > 0.0)), 1)
    if noise_std is None and like is not None:
        noise_std = like.noise_std
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
    for last in range(1 - rounds if like is None else 1, 1):
        prior, at = _by_evidence(inside, seen, found[:size].reshape(support, support), at)
        precision[:size, :size] = prior.precision()
        found = on_simplex(information + precision, weighted, found, solves if last == 0 else 3)
    if like is not None:
        prior, precision = _Prior(_envelope(like.kernel), like.length_px, like.strength), like.precision
        found = on_simplex(information + precision, weighted, found, solves)
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
    solved, on samples of 1 / `oversample` px (`fine`). `far` is the share of the light that lands beyond the kernel's support."""

    channel: str
    kernel: Array
    kernel_std: Array
    covariance: Array
    fine: KernelEstimate
    oversample: int
    far: float
    corner_rms_px: float
    centre_px: tuple[float, float]  # (row, col) of the samples' middle

    def predict(self, fine_kernel: Array) -> Array:
        """Kernel on the sensor's pixels that this estimator reports, at this very place and noise-free, for a predicted one.

        `fine_kernel` is on the grid of `fine.kernel`: `sim.forward.kernel(..., support=len(fine.kernel), oversample=oversample)`.
        """
        fine = self.fine
        size = fine.kernel.size
        data = fine.information[:, :size] @ (np.asarray(fine_kernel, dtype=float).ravel() * (1.0 - self.far))
        data = data + fine.information[:, size] * self.far
        found = on_simplex(fine.information + fine.precision, data, np.append(fine.kernel.ravel(), self.far))
        return _on_pixels(found[:size].reshape(fine.kernel.shape), self.oversample)


@dataclass(frozen=True)
class ScreenField:
    """Kernels of one pose: of every channel over the whole pattern, and of parts of it, row by row."""

    kernels: dict[str, ScreenKernel]
    parts: tuple[ScreenKernel, ...]


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


def measure_kernels(
    pictures: ScreenPictures, cfa: Cfa, support_px: int = 9, oversample: int = 2, patches: int = 0
) -> dict[str, ScreenKernel]:
    """Kernels of all channels of one pose, `support_px` (odd) wide; doubled once where a kernel doesn't fit in.

    The registration from the corners is refined with the kernel, all but a common shift, by Gauss-Newton on the
    residual: first on the green (or only) channel, then on each. `oversample` samples a pixel (2 or 4) resolve the kernel: 4
    is worth its time where the target's cells are about a quarter of a pixel, or the noise is low.
    """
    return measure_field(pictures, cfa, support_px, oversample, patches).kernels


def measure_field(
    pictures: ScreenPictures, cfa: Cfa, support_px: int = 9, oversample: int = 2, patches: int = 3
) -> ScreenField:
    """As `measure_kernels`; and, of the green (or only) channel, the kernels of `patches` x `patches` parts of the pattern,
    each by itself but for registration and prior, which are those of the whole."""
    if oversample not in (2, 4):
        raise ValueError(f"oversample = {oversample} must be 2 or 4 samples a pixel")
    cell = pictures.first.screen.cell_camera_px
    warp = register(
        pictures.checkerboard, pictures.bernoulli, pictures.checkerboard_target, pictures.bernoulli_target, cell
    )
    places, step = phases(cfa), period(cfa)
    reference = "Y" if cfa == "MONO" else "G"
    found: dict[str, ScreenKernel] = {}
    local: list[ScreenKernel] = []
    size = support_px

    def drawn_for(channel: str) -> _Drawn:
        return _Drawn.of(pictures.bernoulli, pictures.bernoulli_target, warp, places[channel], step, size, oversample)

    for channel in (reference, *(name for name in places if name != reference)):
        for _ in range(REGISTRATION_STEPS if channel == reference else 1):
            drawn = drawn_for(channel)
            estimate = solve_kernel(drawn.normal(), drawn.support, far=True, rounds=1)
            if size == support_px and _rim_share(estimate.kernel, oversample) > RIM_SHARE:
                size = 2 * support_px - 1
                continue
            warp = drawn.refined(estimate)
        drawn = drawn_for(channel)
        whole = solve_kernel(drawn.normal(), drawn.support, far=True)
        found[channel] = drawn.described(channel, whole)
        if channel == reference and patches > 1:
            local = [
                part.described(channel, solve_kernel(part.normal(), part.support, far=True, like=whole))
                for part in drawn.parts(patches)
            ]
    return ScreenField({channel: found[channel] for channel in places}, tuple(local))


@dataclass(frozen=True)
class PsfFit:
    """`kernels`: one for every pose, Bernoulli target and channel; `parts`: of the green (or only) channel, over the field;
    `symmetry`: whether the parts fit a lens that looks the same all around its axis, None where they don't tell."""

    kernels: tuple[PsfKernel, ...]
    parts: tuple[PsfKernel, ...]
    symmetry: PsfSymmetry | None


def fit_psf(recordings: RecordingSet, side: Side, noise: NoiseFit | None = None) -> tuple[PsfKernel, ...]:
    """One kernel for every pose of the screen, Bernoulli target and channel of `side`.

    The noise is what the kernel leaves of the levelled picture; `noise` isn't needed for it. `field_mm` is the middle of the
    pattern from the middle of the frame. Raises `NotDetermined` where captures are missing or no pose can be registered.
    """
    del noise  # the residual says it better: it holds the photo response non-uniformity of all four captures too
    return fit_psf_field(recordings, side, patches=0).kernels


def fit_psf_field(recordings: RecordingSet, side: Side, patches: int = 3) -> PsfFit:
    """As `fit_psf`, with the kernels of `patches` x `patches` parts of every pattern and the test of radial symmetry."""
    camera = recordings.camera(side)
    kernels: list[PsfKernel] = []
    parts: list[PsfKernel] = []
    measured: list[ScreenKernel] = []
    reason = ""
    for pictures in screen_pictures(recordings, side):
        try:
            field = measure_field(pictures, camera.cfa, patches=patches)
        except NotDetermined as refused:
            reason = f"{pictures.first.id}: {refused.reason}"
            continue
        kernels += [_reported(camera, pictures.first.id, found) for found in field.kernels.values()]
        parts += [_reported(camera, pictures.first.id, found) for found in field.parts]
        measured += field.parts
    if not kernels:
        raise NotDetermined("psf", reason)
    try:
        symmetry = radial_symmetry(measured, ((camera.rows - 1) / 2.0, (camera.cols - 1) / 2.0))
    except NotDetermined:
        symmetry = None
    return PsfFit(tuple(kernels), tuple(parts), symmetry)


def _reported(camera: Camera, capture: str, found: ScreenKernel) -> PsfKernel:
    return PsfKernel(
        capture=capture,
        channel=found.channel,
        field_mm=_field_mm(camera, found.centre_px),
        sample_pitch_px=1.0,
        psf=tuple(tuple(float(v) for v in values) for values in found.kernel),
        psf_std=tuple(tuple(float(v) for v in values) for values in found.kernel_std),
    )


def expected_kernel(
    transfer: Callable[[Array, Array], NDArray[np.complex128]], support_px: int, cell_px: float, oversample: int = 2
) -> Array:
    """Kernel on the sensor's pixels, (support, support), sum 1, that `measure_kernels` converges to for a transfer function of lens
    and pixel: `transfer(fx, fy)` in cy/px.

    It is the least squares' own: kernels on samples of 1 / `oversample` px that map a random pattern of cells as it is drawn there
    (squares of drawing, the taps that take them out again) to what pixels record of it. Of a lens that passes detail beyond what
    these samples resolve, such a kernel isn't the transfer's own samples, as rims of cells lie anywhere between them. With P the
    pattern's power, D the drawing's response, H the transfer, the normal equations hold integral P D^2 exp(2 pi i f (n - m)) df and
    integral P D H exp(2 pi i f n) df at samples n, m.
    """
    support = oversample * support_px + 1
    fine = 4 * oversample
    count = max(32, 4 * support_px) * fine
    fy, fx = np.fft.fftfreq(count, 1.0 / fine), np.fft.rfftfreq(count, 1.0 / fine)
    taps = _taps(lambda f: np.sinc(f / oversample) ** -2, 0.6, oversample, 2)
    order = np.arange(len(taps)) - len(taps) // 2
    drawn_y, drawn_x = (
        np.sinc(f / oversample) * (np.cos(2.0 * np.pi * f[:, None] * order / oversample) @ taps) for f in (fy, fx)
    )
    power = np.square(np.sinc(cell_px * fy))[:, None] * np.square(np.sinc(cell_px * fx))
    drawn = drawn_y[:, None] * drawn_x
    every = fine // oversample
    own = np.fft.irfft2(power * drawn**2, (count, count))[::every, ::every]
    cross = np.fft.irfft2(power * drawn * transfer(fx[None, :], fy[:, None]), (count, count))[::every, ::every]
    at = np.arange(support) - support // 2
    lag = at[:, None] - at
    matrix = own[lag[:, None, :, None], lag[None, :, None, :]].reshape(support**2, support**2)
    # what a pattern doesn't tell stays small; its mean makes the sum known far better than anything else
    matrix = matrix + 1e-4 * own[0, 0] * np.eye(support**2)
    mean = 1e3 * own[0, 0]
    kernel = np.linalg.solve(matrix + mean, cross[at[:, None], at].ravel() + mean)
    return _on_pixels(kernel.reshape(support, support), oversample)


def radial_symmetry(parts: Sequence[ScreenKernel], axis_px: tuple[float, float]) -> PsfSymmetry:
    """Whether kernels at several places fit a lens that looks the same all around its axis: tested, not assumed.

    Of each kernel the second moments under a Gaussian window of `MOMENT_WINDOW_PX` about its centroid, turned into radial,
    tangential and mixed: of a symmetric lens the mixed one is nil, and the others are even polynomials of the distance from
    the axis that agree on it, here a0 + a r^2 and a0 + b r^2. Generalised least squares with the kernels' covariances; chi2
    beyond its 99.9 % quantile says that the lens isn't symmetric about `axis_px` (row, col). Raises `NotDetermined` below
    five kernels, or where they lie at one distance.
    """
    radius = np.array([np.hypot(k.centre_px[0] - axis_px[0], k.centre_px[1] - axis_px[1]) for k in parts])
    if len(parts) < 5 or np.ptp(radius) < 10.0:
        raise NotDetermined(
            "psf", f"{len(parts)} kernels over the field don't test radial symmetry: 5 at unequal distances do"
        )
    top = float(radius.max())
    values, weights, designs = [], [], []
    for kernel, r in zip(parts, radius, strict=True):
        moments, covariance = _moments(kernel)
        away = np.array(kernel.centre_px) - axis_px
        u = away / r if r > 1e-6 else np.array([1.0, 0.0])
        v = np.array([-u[1], u[0]])
        turn = np.array(  # of (row row, row col, col col) into (radial, tangential, mixed)
            [
                [u[0] ** 2, 2 * u[0] * u[1], u[1] ** 2],
                [v[0] ** 2, 2 * v[0] * v[1], v[1] ** 2],
                [u[0] * v[0], u[0] * v[1] + u[1] * v[0], u[1] * v[1]],
            ]
        )
        values.append(turn @ moments)
        weights.append(np.linalg.inv(turn @ covariance @ turn.T))
        x = (r / top) ** 2
        designs.append(np.array([[1.0, x, 0.0], [1.0, 0.0, x], [0.0, 0.0, 0.0]]))
    normal = sum(d.T @ w @ d for d, w in zip(designs, weights, strict=True))
    right = sum(d.T @ w @ v for d, w, v in zip(designs, weights, values, strict=True))
    solution = np.linalg.solve(normal, right)
    gaps = [v - d @ solution for v, d in zip(values, designs, strict=True)]
    chi2 = float(sum(g @ w @ g for g, w in zip(gaps, weights, strict=True)))
    freedom = 3 * len(parts) - 3
    pulls = [float(g[2] * np.sqrt(w[2, 2])) for g, w in zip(gaps, weights, strict=True)]
    return PsfSymmetry(
        kernels=len(parts),
        chi2=chi2,
        degrees_of_freedom=freedom,
        probability=float(special.chdtrc(freedom, chi2)),
        symmetric=chi2 < float(special.chdtri(freedom, 0.001)),
        variance_on_axis_px2=float(solution[0]),
        radial_growth_px2=float(solution[1]),
        tangential_growth_px2=float(solution[2]),
        largest_mixed_sigma=max(pulls, key=abs),
    )


def _moments(kernel: ScreenKernel) -> tuple[Array, Array]:
    """Windowed second moments (row row, row col, col col) of a kernel, px^2, and their covariance."""
    half = len(kernel.kernel) // 2
    row, col = np.meshgrid(*(np.arange(-half, half + 1.0),) * 2, indexing="ij")
    centre = np.zeros(2)
    for _ in range(8):  # the window's centre is the windowed centroid
        r, c = row - centre[0], col - centre[1]
        window = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2) * kernel.kernel
        centre += np.array([(window * r).sum(), (window * c).sum()]) / window.sum()
    weight = np.exp(-0.5 * (r**2 + c**2) / MOMENT_WINDOW_PX**2)
    total = float((weight * kernel.kernel).sum())
    terms = np.stack([r * r, r * c, c * c]).reshape(3, -1) * weight.ravel() / total
    moments = terms @ kernel.kernel.ravel()
    slopes = terms - moments[:, None] * weight.ravel() / total
    return moments, slopes @ kernel.covariance @ slopes.T


@dataclass(frozen=True)
class PhotographedKernel:
    """Kernel from one photograph of a pattern: on the sensor's pixels and on samples of 1 / `oversample` px, with the share of
    the pixels' variance over the pattern that it explains, and that a homography and the pixel's square explain without it."""

    kernel: Array
    kernel_std: Array
    fine: KernelEstimate
    oversample: int
    warp: ScreenWarp
    explained: float
    explained_by_box: float
    samples: int


def photographed_kernel(
    photo: ArrayLike,
    pattern: NDArray[np.uint8],
    support_px: int = 5,
    oversample: int = 4,
    corners: ArrayLike | None = None,
) -> PhotographedKernel:
    """Kernel from a single photograph (rows, cols), linear, one channel, of a printed or shown pattern (0 dark, 1 lit).

    There are no white and black captures and no checkerboard: levels are planes in the frame, fitted with the kernel, and the
    place is found by the pattern itself: where the picture is busiest, in any quarter turn, or at `corners` (4, 2): (x, y) of
    the pattern's corners, clockwise from its own top left. Then homography, cubic displacement and kernel in turn.
    Raises `NotDetermined` where the pattern isn't seen.
    """
    seen, target = np.asarray(photo, dtype=float), np.asarray(pattern, dtype=np.uint8)
    if seen.ndim != 2 or target.ndim != 2 or not np.isfinite(seen).all():
        raise NotDetermined("psf", "photograph and pattern have to be two-dimensional, the photograph finite")
    quad = busiest_quadrilateral(seen) if corners is None else np.asarray(corners, dtype=float)
    # Only what is around the pattern is looked at
    first = np.maximum(np.floor(quad.min(axis=0)).astype(int) - PHOTO_MARGIN_PX, 0)
    last = np.ceil(quad.max(axis=0)).astype(int) + PHOTO_MARGIN_PX + 1
    seen, quad = seen[first[1] : last[1], first[0] : last[0]], quad - first
    turns = [np.roll(quad, turn, axis=0) for turn in range(4 if corners is None else 1)]
    rough = [_aligned(seen, target, ScreenWarp.of_corners(turn, target.shape), (2.5, 1.5)) for turn in turns]
    warp, _ = max(rough, key=lambda found: found[1])
    warp, agreement = _aligned(seen, target, warp, (1.0, 0.7, 0.5))
    if agreement < MATCH:
        raise NotDetermined("psf", f"the photograph doesn't show the pattern (correlation {max(agreement, 0.0):.2f})")
    by_box = _box_share(seen, target, warp)
    light = seen
    for _ in range(PHOTO_ROUNDS):
        drawn = _Drawn.of(light, target, warp, [(0, 0)], 1, support_px, oversample)
        at = (drawn.row, drawn.col)
        if light is seen:
            predicted = ndimage.gaussian_filter(drawn.picture, 0.6 * oversample)
        predicted = predicted[oversample * drawn.row, oversample * drawn.col]
        low, contrast = _levels(seen[at], predicted, *at, seen.shape)
        light = (seen - low) / contrast
        drawn = replace(drawn, value=light[at])
        estimate = solve_kernel(drawn.normal(), drawn.support, far=True, rounds=1)
        predicted = drawn.blurred(estimate)
        warp = drawn.refined(estimate)
    drawn = _Drawn.of(light, target, warp, [(0, 0)], 1, support_px, oversample)
    estimate = solve_kernel(drawn.normal(), drawn.support, far=True)
    described = drawn.described("Y", estimate)
    at = (drawn.row, drawn.col)
    model = (low + contrast * drawn.blurred(estimate)[::oversample, ::oversample])[at]
    return PhotographedKernel(
        kernel=described.kernel,
        kernel_std=described.kernel_std,
        fine=estimate,
        oversample=oversample,
        warp=warp.moved(first),
        explained=1.0 - float(np.sum((seen[at] - model) ** 2) / np.sum((seen[at] - seen[at].mean()) ** 2)),
        explained_by_box=by_box,
        samples=len(drawn.row),
    )


def _levels(
    seen: Array, predicted: Array, row: NDArray[np.int64], col: NDArray[np.int64], shape: tuple[int, ...]
) -> tuple[Array, Array]:
    """Dark level and contrast, (rows, cols), as planes in the frame, by least squares of seen = low + contrast x predicted."""

    def plane(r: Array, c: Array) -> Array:
        return np.stack([np.ones(np.broadcast(r, c).shape), r / shape[0] + 0.0 * c, c / shape[1] + 0.0 * r])

    terms = plane(row.astype(float), col.astype(float))
    solution = np.linalg.lstsq(np.concatenate([terms, terms * predicted]).T, seen, rcond=None)[0]
    everywhere = plane(np.arange(shape[0], dtype=float)[:, None], np.arange(shape[1], dtype=float)[None])
    low, contrast = (np.tensordot(part, everywhere, axes=1) for part in (solution[:3], solution[3:]))
    if not (contrast[row, col] > 0.0).all():
        raise NotDetermined("psf", "the photograph shows the pattern with no contrast, or reversed")
    return low, np.where(contrast > 0.0, contrast, np.nan)


def _aligned(
    seen: Array, target: NDArray[np.uint8], warp: ScreenWarp, blurs_px: Sequence[float]
) -> tuple[ScreenWarp, float]:
    """The warp improved by Gauss-Newton on the picture blurred by ever less, and how well the last one correlates."""
    agreement = -1.0
    for blur in blurs_px:
        smooth = ndimage.gaussian_filter(seen, blur)
        for _ in range(ALIGN_STEPS):
            # far enough inside that nothing of what is around the pattern is blurred in
            drawn = _Drawn.of(smooth, target, warp, [(0, 0)], 1, int(5.0 * blur) | 1, 2, least=200)
            predicted = ndimage.gaussian_filter(drawn.picture, 2.0 * float(np.hypot(blur, 0.4)))
            at = (2 * drawn.row, 2 * drawn.col)
            value, there = drawn.value, predicted[at]
            agreement = float(np.corrcoef(value, there)[0, 1])
            gain, low = np.polyfit(there, value, 1)
            gain = max(float(gain), 1e-6)
            down, across = (np.gradient(predicted, 0.5, axis=axis)[at] for axis in (0, 1))
            terms = warp.basis(np.column_stack([drawn.col, drawn.row]).astype(float))
            terms = terms[: 3 if blur > 2.0 else 6 if blur > 0.9 else len(terms)]
            columns = np.concatenate([gain * across * terms, gain * down * terms, terms[:3], there * terms[:3]])
            step = np.linalg.lstsq(columns @ columns.T, columns @ (value - low - gain * there), rcond=1e-9)[0][:-6]
            change = np.zeros((2, len(warp.displacement[0])))
            change[:, : len(terms)] = np.clip(step, -blur, blur).reshape(2, -1)
            warp = warp.displaced(change)
    return warp, agreement


def _box_share(seen: Array, target: NDArray[np.uint8], warp: ScreenWarp) -> float:
    """Share of the variance that the pattern drawn by area on the pixels explains, levels free."""
    drawn = _Drawn.of(seen, target, warp, [(0, 0)], 1, 1, 2)
    pixel = ndimage.correlate1d(drawn.picture, [0.25, 0.5, 0.25], axis=0)
    pixel = ndimage.correlate1d(pixel, [0.25, 0.5, 0.25], axis=1)[2 * drawn.row, 2 * drawn.col]
    return float(np.corrcoef(pixel, drawn.value)[0, 1] ** 2)


def _field_mm(camera: Camera, at_px: tuple[float, float]) -> tuple[float, float] | None:
    """Of a place in the frame, from its middle, at the sensor."""
    if camera.pixel_pitch_um is None:
        return None
    pitch_mm = 1e-3 * camera.pixel_pitch_um
    return pitch_mm * (at_px[0] - (camera.rows - 1) / 2.0), pitch_mm * (at_px[1] - (camera.cols - 1) / 2.0)


def _rim_share(kernel: Array, oversample: int) -> float:
    """Share of the kernel in its outermost pixel."""
    inside = slice(oversample, -oversample)
    return float(1.0 - kernel[inside, inside].sum() / kernel.sum())


def _on_pixels(fine: Array, oversample: int) -> Array:
    """From samples of 1 / oversample px to pixels, sum 1."""
    matrix = _pixel_matrix(len(fine), oversample)
    kernel = matrix @ fine @ matrix.T
    return np.asarray(kernel / kernel.sum())


def _pixel_matrix(size: int, oversample: int) -> Array:
    """One axis: light over a whole pixel is light over `oversample` narrower ones, side by side: sinc(f) / sinc(f / oversample)."""
    reach = oversample
    half = (size // 2 - oversample // 2) // oversample
    taps = _taps(lambda f: np.sinc(f) / np.sinc(f / oversample), 0.8, oversample, reach)
    matrix = np.zeros((2 * half + 1, size + 2 * reach))
    for row in range(2 * half + 1):
        middle = size // 2 + reach + oversample * (row - half)
        matrix[row, middle - reach : middle + reach + 1] = taps
    return matrix[:, reach : matrix.shape[1] - reach]


def _taps(response: Callable[[Array], Array], highest_cy_per_px: float, oversample: int, reach: int) -> Array:
    """2 reach + 1 symmetric taps on samples of 1 / oversample px with a given response, 1 at 0, by least squares up to
    `highest_cy_per_px`."""
    frequency = np.linspace(0.0, highest_cy_per_px, 61)
    order = np.arange(reach + 1)
    terms = np.cos(2.0 * np.pi * frequency[:, None] * order / oversample) * np.where(order > 0, 2.0, 1.0)
    weight = np.where(frequency == 0.0, 1e3, 1.0)
    # finely sampled taps hardly differ over the band: the least of the solutions
    taps = np.linalg.lstsq(terms * weight[:, None], weight * response(frequency), rcond=1e-9)[0]
    taps = np.concatenate([taps[:0:-1], taps])
    return np.asarray(taps / taps.sum())


@dataclass(frozen=True)
class _Drawn:
    """The target drawn on samples of 1 / oversample px through a warp, and one channel's pixels on it."""

    warp: ScreenWarp
    picture: Array  # drawn, (oversample rows, oversample cols)
    around: Array  # its mean over the surroundings: what light from beyond the support sees
    row: NDArray[np.int64]  # of the samples, px
    col: NDArray[np.int64]
    value: Array
    support: int  # samples of 1 / oversample px
    oversample: int

    @staticmethod
    def of(
        seen: Array,
        pattern: NDArray[np.uint8],
        warp: ScreenWarp,
        places: Sequence[tuple[int, int]],
        step: int,
        support_px: int,
        oversample: int,
        least: int = 0,
    ) -> _Drawn:
        """`seen` is the pattern as the camera saw it, 0 dark .. 1 lit, NaN where it isn't to be used. Fewer than `least`
        pixels are refused: twice as many as the kernel has elements."""
        rows, cols = seen.shape
        target = pattern.astype(float)
        # The map is smooth: worked out on a coarse grid, interpolated by cubic splines
        y, x = np.arange(-8.0, rows + 16.0, 8.0), np.arange(-8.0, cols + 16.0, 8.0)
        at = warp.cells(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x), 2)
        fine_y, fine_x = np.arange(oversample * rows) / oversample, np.arange(oversample * cols) / oversample
        cell_x, cell_y = (RectBivariateSpline(y, x, at[:, :, k])(fine_y, fine_x) for k in (0, 1))
        picture = area_drawn(target, cell_x, cell_y)
        # The squares of drawing and of the kernel's grid, a sample each, are taken out again
        taps = _taps(lambda f: np.sinc(f / oversample) ** -2, 0.6, oversample, 2)
        for axis in (0, 1):
            picture = ndimage.correlate1d(picture, taps, axis=axis, mode="nearest")
        wide = oversample * support_px
        around = cv2.GaussianBlur(picture, (6 * wide + 1,) * 2, wide, borderType=cv2.BORDER_REPLICATE)

        coarse = np.gradient(at[:, :, 0])
        margin = (support_px / 2.0 + 2.0) * float(np.hypot(coarse[0].mean(), coarse[1].mean())) / 8.0  # cells
        inside = (
            (cell_x > margin)
            & (cell_x < target.shape[1] - margin)
            & (cell_y > margin)
            & (cell_y < target.shape[0] - margin)
        )
        usable = inside[::oversample, ::oversample] & np.isfinite(seen)
        usable[: support_px + 1] = usable[-support_px - 1 :] = False
        usable[:, : support_px + 1] = usable[:, -support_px - 1 :] = False
        mine = np.zeros_like(usable)
        for row0, col0 in places:
            mine[row0::step, col0::step] = True
        row, col = np.nonzero(usable & mine)
        support = oversample * support_px + 1  # odd, as oversample x support_px is even
        if len(row) < (least or 2 * support**2):
            raise NotDetermined(
                "psf", f"only {len(row)} pixels of the channel see the pattern: let it fill more of the frame"
            )
        return _Drawn(warp, picture, around, row, col, seen[row, col], support, oversample)

    def parts(self, count: int) -> list[_Drawn]:
        """The pixels in `count` x `count` parts of about as many rows and columns; parts of too few pixels are left out."""
        across = [np.linspace(v.min(), v.max() + 1, count + 1) for v in (self.row, self.col)]
        found = []
        for top, bottom in zip(across[0][:-1], across[0][1:], strict=True):
            for left, right in zip(across[1][:-1], across[1][1:], strict=True):
                chosen = (self.row >= top) & (self.row < bottom) & (self.col >= left) & (self.col < right)
                if np.count_nonzero(chosen) >= 2 * self.support**2:
                    found.append(self.within(chosen))
        return found

    def within(self, chosen: NDArray[np.bool_]) -> _Drawn:
        """Only the pixels `chosen`, (n,)."""
        return replace(self, row=self.row[chosen], col=self.col[chosen], value=self.value[chosen])

    def normal(self) -> Normal:
        """Normal equations of the kernel's elements and, last, of the light from beyond."""
        s, h = self.support, self.support // 2
        size = s * s + 1
        gram, right = np.zeros((size, size)), np.zeros(size)
        # turned by 180 degrees, as the kernel is against the picture
        windows = np.lib.stride_tricks.sliding_window_view(self.picture[::-1, ::-1], (s, s))
        last = np.array(windows.shape[:2]) - 1
        for start in range(0, len(self.row), 4096):
            part = slice(start, start + 4096)
            row, col, value = self.oversample * self.row[part], self.oversample * self.col[part], self.value[part]
            design = np.empty((len(row), size))
            design[:, :-1] = windows[last[0] - row + h, last[1] - col + h].reshape(len(row), -1)
            design[:, -1] = self.around[row, col]
            gram += design.T @ design
            right += value @ design
        return Normal(gram, right, float(self.value @ self.value), len(self.row))

    def blurred(self, estimate: KernelEstimate) -> Array:
        """The picture through the kernel, on its own samples."""
        from scipy.signal import fftconvolve  # here: the library takes a while to load

        return np.asarray(
            (1.0 - estimate.far) * fftconvolve(self.picture, estimate.kernel, mode="same") + estimate.far * self.around
        )

    def refined(self, estimate: KernelEstimate) -> ScreenWarp:
        """One Gauss-Newton step of the displacement, all but a common shift, which is the kernel's to say."""
        blurred, at = self.blurred(estimate), (self.oversample * self.row, self.oversample * self.col)
        down, across = (np.gradient(blurred, 1.0 / self.oversample, axis=axis)[at] for axis in (0, 1))
        residual = self.value - blurred[at]
        terms = self.warp.basis(np.column_stack([self.col, self.row]).astype(float))[1:]
        mean = terms.mean(axis=1)
        terms = terms - mean[:, None]
        columns = np.concatenate([across * terms, down * terms])
        inlier = np.abs(residual) < 5.0 * np.sqrt(np.mean(residual**2))
        step = np.linalg.lstsq((columns * inlier) @ columns.T, (columns * inlier) @ residual, rcond=1e-10)[0]
        step = step.reshape(2, -1)
        return self.warp.displaced(np.column_stack([-step @ mean, step]))

    def described(self, channel: str, estimate: KernelEstimate) -> ScreenKernel:
        matrix = _pixel_matrix(self.support, self.oversample)
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
            oversample=self.oversample,
            far=estimate.far,
            corner_rms_px=self.warp.corner_rms_px,
            centre_px=(float(self.row.mean()), float(self.col.mean())),
        )


def area_drawn(target: Array, cell_x: Array, cell_y: Array) -> Array:
    """Mean of the pattern over a sample's square around points at `cell_x`, `cell_y` (cells); dark outside. The square is
    taken as aligned with the cells: its turn counts in second order only. A square may hold any number of cells."""
    from sim.scene.area import aligned_means  # here: the compiler's library takes a while to load

    table = np.pad(target.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    wide, high = (
        float(sum(np.abs(part).mean() for part in np.gradient(cell[::16, ::16]))) / 16.0 for cell in (cell_x, cell_y)
    )
    return np.asarray(aligned_means(table, cell_x, cell_y, wide, high))


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

    def seen_right(self, weighted: Array) -> Array:
        """R^T weighted."""
        power, waves = self._eigen()
        scaled = (self.strength * self.envelope * weighted).reshape(self.support, self.support)
        return np.asarray((waves.T @ scaled @ waves).ravel() * np.sqrt(power))

    def posterior(self, information: Array) -> Array:
        """Covariance of the kernel, given the data and that the sum is 1."""
        inner = self.seen(information)
        inner[np.diag_indices_from(inner)] += 1.0
        factor = linalg.cholesky(inner, lower=True, check_finite=False)
        half = linalg.solve_triangular(factor, self.root().T, lower=True, check_finite=False)
        covariance = half.T @ half
        share = covariance.sum(axis=1)
        return np.asarray(covariance - np.outer(share, share) / share.sum())


def _evidence(inner: Array, right: Array) -> float:
    """Log of the probability of the data under a prior, but for a constant, from R^T information R and R^T weighted."""
    inner[np.diag_indices_from(inner)] += 1.0
    factor = linalg.cholesky(inner, lower=True, overwrite_a=True, check_finite=False)
    half = linalg.solve_triangular(factor, right, lower=True, check_finite=False)
    return float(0.5 * half @ half - np.log(np.diag(factor)).sum())


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
    unscaled: dict[int, tuple[Array, Array]] = {}  # what the strength only scales, by length

    def value(at: tuple[int, int]) -> float:
        if not (0 <= at[0] < len(LENGTHS_PX) and 0 <= at[1] < len(STRENGTHS)):
            return -np.inf
        if at not in tried:
            if at[0] not in unscaled:
                unit = _Prior(envelope, LENGTHS_PX[at[0]], 1.0)
                unscaled[at[0]] = unit.seen(information), unit.seen_right(weighted)
            prior = _Prior(envelope, LENGTHS_PX[at[0]], STRENGTHS[at[1]] * top)
            inner, right = unscaled[at[0]]
            tried[at] = _evidence(inner * prior.strength**2, right * prior.strength), prior
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


def on_simplex(quadratic: Array, linear: Array, start: Array, solves: int = MOST_SOLVES) -> Array:
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
    """Exact optimum from a nearby point by block principal pivoting: solve on the support, exchange all that is on the wrong
    side (negative, or wanted by the gradient); where that stops to gain, only the last of them, which ends for certain."""
    free = x > 0.0
    fewest, patience = len(c) + 1, PATIENCE
    tolerance = 1e-10 * np.abs(c).max()
    for _ in range(solves):
        at = np.flatnonzero(free)
        factor = linalg.cho_factor(q[np.ix_(at, at)], check_finite=False)
        both = linalg.cho_solve(factor, np.column_stack([c[at], np.ones(len(at))]), check_finite=False)
        multiplier = (1.0 - both[:, 0].sum()) / both[:, 1].sum()
        solution = np.zeros_like(x)
        solution[at] = both[:, 0] + multiplier * both[:, 1]
        pull = c - q[:, at] @ solution[at] + multiplier
        wrong = np.flatnonzero((free & (solution < 0.0)) | (~free & (pull > tolerance)))
        x = solution
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        elif patience > 0:
            patience -= 1
        else:
            wrong = wrong[-1:]
        free[wrong] = ~free[wrong]
    x = np.maximum(x, 0.0)
    return np.asarray(x / x.sum())
