"""The entry for a point of the image: what blurs it. Transfer functions, edges' profiles, kernels, displaced light,
veils.

Frequencies are cy/px, fx along columns (to the right), fy along rows (down). Without effects, or with effects at their
absent values, the result is the baseline bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from sim.camera import CameraModel
from sim.detection import check_finite, detect_light, otf_wavelengths, otf_weight
from sim.optics.diffraction import aperture_otf
from sim.sensor import mosaic
from sim.spectrum import FloatArray, Spectrum, gauss_rule, lagrange_shares, linear_shares
from sim.stages import Acts, Charge, ComplexArray, Image, Signal, charge_of, image_of, kernel_otf, signal_of

#: Quantities of the stages that a transfer function depends on.
TRANSFER = frozenset(
    {
        "image.pupil",
        "image.pupil_at",
        "image.transfer",
        "image.veils",
        "charge.transfer",
        "charge.kernels",
        "charge.trails",
        "signal.filters",
    }
)

#: Those that a transfer function at a place depends on, where wavelengths land apart.
TRANSFER_AT = TRANSFER | {"image.shift"}

#: Wavelengths at which an optical transfer function is averaged over light and sensitivity
#: (Gauss's rule for that weight): within 1e-4 of a 1 nm sum.
OTF_WAVELENGTHS = 10

#: Sum of the magnitudes of a sight's shares beyond which the nodes don't stand for its light: it lies beside them.
MOST_SHARES = 2.0

#: Wavelengths that land as near to each other as this are one image.
TOGETHER_PX = 1e-9

#: Frequencies beyond which an edge's profile isn't followed: 64 cy/px, where a pixel's aperture passes < 0.5 %.
HIGHEST_CY_PER_PX = 64.0


class Blur:
    """Transfer of lens and effects at one wavelength, without the pixel's aperture; the stages' states taken once."""

    def __init__(
        self, camera: CameraModel, effects: Sequence[Acts] = (), *, collected: bool = False, moving: bool = True
    ) -> None:
        """`collected`: what frames are drawn with: without light that is scattered evenly over the frame, without what
        moves charge between pixels, and without filters on the chip. `moving`: with what moves charge between pixels,
        as among pixels of one colour; `mix_channels` has it for a mosaic.
        """
        self.camera = camera
        image = image_of(camera, effects)
        self.image: Image = image.remove_veil() if collected else image
        self.charge: Charge = charge_of(camera, effects)
        self.signal = Signal(camera) if collected else signal_of(camera, effects)
        self.moving = moving and not collected
        self.kernels = self.charge.kernels if self.moving else ()

    def at(
        self,
        wavelength_nm: float,
        fx_cy_per_px: FloatArray,
        fy_cy_per_px: FloatArray,
        place_um: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray | ComplexArray:
        """At frequencies in cy/px, which broadcast, and a place."""
        fx, fy = fx_cy_per_px / self.camera.pixel_pitch_um, fy_cy_per_px / self.camera.pixel_pitch_um
        lens = self.image.otf(fx, fy, wavelength_nm, place_um)
        return times(lens, self._in_pixels(wavelength_nm, fx_cy_per_px, fy_cy_per_px, place_um))

    def beside_lens(
        self,
        wavelength_nm: float,
        fx_cy_per_px: FloatArray,
        fy_cy_per_px: FloatArray,
        place_um: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray | ComplexArray:
        """Return the same over the transfer of the lens without effects."""
        fx, fy = fx_cy_per_px / self.camera.pixel_pitch_um, fy_cy_per_px / self.camera.pixel_pitch_um
        effects_otf = self.image.otf_beside_lens(fx, fy, wavelength_nm, place_um)
        return times(effects_otf, self._in_pixels(wavelength_nm, fx_cy_per_px, fy_cy_per_px, place_um))

    @property
    def is_lens_alone(self) -> bool:
        """Return whether no effect blurs."""
        states = (*self.image.list_laws(), *self.charge.list_laws(), *self.signal.list_laws())
        return not TRANSFER.intersection(states)

    def _in_pixels(
        self, wavelength_nm: float, fx_cy_per_px: FloatArray, fy_cy_per_px: FloatArray, place_um: tuple[float, float]
    ) -> FloatArray | ComplexArray | float:
        pitch = self.camera.pixel_pitch_um
        value: FloatArray | ComplexArray | float = self.charge.otf(
            fx_cy_per_px / pitch, fy_cy_per_px / pitch, wavelength_nm
        )
        for kernel in self.kernels:
            value = value * kernel_otf(kernel, fx_cy_per_px, fy_cy_per_px)
        if self.moving and self.charge.trails:
            value = cast(
                "FloatArray | ComplexArray", value * self.charge.trail_otf(fx_cy_per_px, fy_cy_per_px, place_um)
            )
        plane = mosaic.step(self.camera.cfa)  # filters on the chip run over each colour's plane
        for kernel in self.signal.filters:
            value = value * kernel_otf(kernel, plane * fx_cy_per_px, plane * fy_cy_per_px)
        return value


def times(transfer: FloatArray | ComplexArray, factor: FloatArray | ComplexArray | float) -> FloatArray | ComplexArray:
    """Product of transfer functions."""
    return cast("FloatArray | ComplexArray", transfer * factor)


def varies_over_field(camera: CameraModel, effects: Sequence[Acts]) -> bool:
    """Return whether any effect's path error, how far it lets wavelengths land apart, or the charge that is left behind
    on its way to the output, changes with the place."""
    image = image_of(camera, effects)
    return bool(image.pupil_at) or image.moves or bool(charge_of(camera, effects).trails)


def displaced_um(
    camera: CameraModel, x_um: FloatArray, y_um: FloatArray, wavelength_nm: float, effects: Sequence[Acts]
) -> tuple[FloatArray, FloatArray] | None:
    """Return how far (dx, dy) effects let light of one wavelength land from the place where the baseline has it; None
    where they don't.
    """
    image = image_of(camera, effects)
    if not image.moves:
        return None
    right, down = image.shift_um(x_um, y_um, wavelength_nm)
    return np.asarray(right), np.asarray(down)


def dispersal(
    camera: CameraModel,
    wavelength_nm: FloatArray,
    shares: FloatArray,
    fx_cy_per_px: FloatArray,
    fy_cy_per_px: FloatArray,
    effects: Sequence[Acts],
    places_um: Sequence[tuple[float, float]],
) -> ComplexArray | None:
    """Factors on the transfer functions of single wavelengths, (sights, wavelengths, *frequencies), by which a sight's
    wavelengths land apart: the mean over places of exp(-2 pi i f (s(wavelength) - s(mean wavelength))), s the shift of
    light that lands off.

    `shares`: how much each wavelength (nm) counts for each sight, (sights, wavelengths), sum 1. None where all land
    together.
    """
    image = image_of(camera, effects)
    if not image.moves:
        return None
    x, y = (np.array(part, float) for part in zip(*places_um, strict=True))

    def shift_px(at_nm: float) -> FloatArray:
        pair = (np.broadcast_to(np.asarray(part, float), x.shape) for part in image.shift_um(x, y, at_nm))
        return np.array(list(pair)) / camera.pixel_pitch_um

    single = np.array([shift_px(float(w)) for w in wavelength_nm])
    apart = single - np.array([shift_px(float(mean)) for mean in shares @ wavelength_nm])[:, None]
    if np.max(np.abs(apart)) < TOGETHER_PX:
        return None
    factor = np.zeros((*apart.shape[:2], *np.broadcast_shapes(fx_cy_per_px.shape, fy_cy_per_px.shape)), complex)
    for across, down in np.moveaxis(apart, (3, 2), (0, 1)):  # of (sights, wavelengths, 2, places)
        turns = np.multiply.outer(across, fx_cy_per_px) + np.multiply.outer(down, fy_cy_per_px)
        factor += np.exp(-2j * np.pi * turns)
    return np.asarray(factor / x.size, complex)


def detected_transfer(
    camera: CameraModel,
    wavelength_nm: FloatArray,
    shares: FloatArray,
    transfers: NDArray[np.inexact[Any]],
    fx_cy_per_px: FloatArray,
    fy_cy_per_px: FloatArray,
    effects: Sequence[Acts],
    places_um: Sequence[tuple[float, float]],
) -> ComplexArray:
    """Transfer functions of sights, (sights, *frequencies), of those of single wavelengths,
    (wavelengths, *frequencies): the sum over wavelengths of share x transfer x `dispersal`.
    """
    apart = dispersal(camera, wavelength_nm, shares, fx_cy_per_px, fy_cy_per_px, effects, places_um)
    if apart is None:
        return np.asarray(np.tensordot(shares, transfers, 1), complex)
    return np.asarray(np.einsum("sw,sw...,w...->s...", shares, apart, transfers), complex)


def mixes_colours(camera: CameraModel, effects: Sequence[Acts]) -> bool:
    """Return whether effects move charge between pixels of different colours."""
    charge = charge_of(camera, effects)
    return camera.cfa != "MONO" and bool(charge.kernels or charge.trails)


def mix_channels(
    camera: CameraModel,
    transfers: ComplexArray,
    signals: FloatArray,
    fx_cy_per_px: FloatArray,
    fy_cy_per_px: FloatArray,
    effects: Sequence[Acts],
    place_um: tuple[float, float] = (0.0, 0.0),
) -> ComplexArray:
    """Transfer functions of a mosaic's channels after charge has moved between pixels, (channels, *frequencies), from
    those before and each channel's mean signal before, (channels,), on any scale.

    T'_c(f) = sum_n k_n s_n T_n(f) exp(-2 pi i f n) / sum_n k_n s_n, over the offsets n of the kernel k of all moves
    together; s_n and T_n are of the channel from which charge moves by n to a pixel of channel c. Of a channel with
    several phases in the mosaic, their mean. `place_um` matters to charge that is left behind on its way to the output.
    """
    from scipy.signal import convolve2d  # here: the library takes a while to load

    charge = charge_of(camera, effects)
    kernel = reduce(convolve2d, [*charge.kernels, *charge.trail_kernels(place_um)], np.ones((1, 1)))
    step, phases, count = mosaic.step(camera.cfa), mosaic.phases(camera.cfa), len(camera.channels)
    source_at = np.zeros((step, step), int)
    for i, name in enumerate(camera.channels):
        source_at[tuple(np.transpose(phases[name]))] = i
    down, right = (np.arange(n) - n // 2 for n in kernel.shape)
    # the electrons that come from each source by each offset, (channels, sources, down, right)
    moved = np.zeros((count, count, *kernel.shape))
    for i, name in enumerate(camera.channels):
        for row, col in phases[name]:
            source = source_at[np.ix_((row - down) % step, (col - right) % step)]
            for k in range(count):
                moved[i, k] += np.where(source == k, kernel * float(signals[k]), 0.0)
    shape = transfers.shape[1:]
    fx, fy = (np.broadcast_to(f, shape).ravel() for f in (fx_cy_per_px, fy_cy_per_px))
    total = moved.sum(axis=(1, 2, 3))
    across, along = _turned(down, fy), _turned(right, fx)
    if len(down) > len(right):  # the longer side by one product: trails are lines
        across, along, moved = along, across, moved.swapaxes(2, 3)
    out = np.zeros((count, len(fx)), complex)
    for i, k, d in np.argwhere(moved.any(axis=3)):
        line = (moved[i, k, d] @ along.view(float)).view(complex)
        out[i] += line * across[d] * transfers[k].ravel()
    lit = total > 0.0
    out[lit] /= total[lit, None]
    out[~lit] = transfers.reshape(count, -1)[~lit]  # no light: as it was
    return np.asarray(out.reshape(transfers.shape))


def _turned(steps: NDArray[np.integer[Any]], f: FloatArray) -> ComplexArray:
    """Return exp(-2 pi i f n) of successive whole n, (n, frequencies)."""
    turn = np.exp(-2j * np.pi * f)
    factors = np.broadcast_to(turn, (len(steps), len(f))).copy()
    factors[0] = turn ** steps[0]
    return np.asarray(np.cumprod(factors, axis=0))


def trail_behind(camera: CameraModel, effects: Sequence[Acts], axis: Literal[0, 1], line: float, lag_px: int) -> float:
    """Return by how much the pixel `lag_px` lines behind one that alone has charge exceeds that before it, over that
    one's signal; `axis` 0 along a column, 1 along a row, `line` its place there."""
    asymmetry = 0.0
    charge = charge_of(camera, effects)
    lines = (camera.rows, camera.cols)[axis]
    for law in charge.trails:
        if law.axis == axis:
            kernel = np.ravel(law.kernel(float(law.transfers(np.asarray(line), lines))))
            middle = len(kernel) // 2
            asymmetry += float((kernel[middle + lag_px] - kernel[middle - lag_px]) / kernel[middle])
    return asymmetry


def even_share(camera: CameraModel, effects: Sequence[Acts]) -> float:
    """Return the share of the light that effects spread evenly over the frame."""
    return 1.0 - float(np.prod([1.0 - veil.even_share for veil in image_of(camera, effects).veils]))


def halos(camera: CameraModel, effects: Sequence[Acts]) -> list[tuple[float, float]]:
    """Share and standard deviation (px) of what effects spread widely about its place."""
    veils = image_of(camera, effects).veils
    return [(v.halo_share, v.halo_std_um / camera.pixel_pitch_um) for v in veils if v.halo_share > 0.0]


def wide_contrast(
    camera: CameraModel, effects: Sequence[Acts], frequency_cy_per_px: FloatArray | float = np.inf
) -> FloatArray:
    """Contrast that veils and halos leave at a frequency that the frame holds; as it stands to anything smaller than
    the halos.
    """
    left: FloatArray = np.ones(np.shape(frequency_cy_per_px))
    for veil in image_of(camera, effects).veils:
        kept = np.exp(-2.0 * np.square(np.pi * veil.halo_std_um / camera.pixel_pitch_um * frequency_cy_per_px))
        left = left * (1.0 - veil.even_share - veil.halo_share * (1.0 - kept))
    return left


def optical_transfer(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    fx_cy_per_px: ArrayLike,
    fy_cy_per_px: ArrayLike,
    effects: Sequence[Acts] = (),
    kind: str = "slanted_edge",
    *,
    reflectance: Spectrum | None = None,
    place_um: tuple[float, float] = (0.0, 0.0),
    collected: bool = False,
) -> ComplexArray:
    """Optical transfer function of one channel, 1 at zero frequency; complex, of the broadcast shape of fx and fy
    (cy/px).

    The average of the lens's transfer (`Lens.imaging`) x the effects', weighted by the detected electrons
    (light x responsivity) over wavelength, times the pixel's aperture. `radiance` None: light of equal energy at every
    wavelength. `place_um`: where, for path errors that change over the field and wavelengths that land apart
    (about where the mean wavelength lands). `collected`: as the pixels collect it, before light that is scattered over
    the whole frame is added, charge moves between pixels and filters on the chip act: what a frame is drawn with, in
    which these act on the pixels themselves.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_px, float), np.asarray(fy_cy_per_px, float))
    mixing = not collected and mixes_colours(camera, effects)
    blur = Blur(camera, effects, collected=collected, moving=not mixing)
    transfers, signals = [], []
    for name in camera.channels if mixing else (channel,):
        wavelength_nm, weight = detect_light(camera, name, [(radiance, reflectance)], effects, kind)
        nodes, share = otf_wavelengths(camera, name, wavelength_nm, weight[0], OTF_WAVELENGTHS)
        total: FloatArray | ComplexArray = np.zeros(fx.shape)
        apart = dispersal(camera, nodes, share[None], fx, fy, effects, [place_um])
        for k, (node, part) in enumerate(zip(nodes, share, strict=True)):
            single = blur.at(float(node), fx, fy, place_um)
            total = total + part * (single if apart is None else single * apart[0, k])
        transfers.append(np.asarray(total * aperture_otf(fx, fy, camera.fill_factor), complex))
        signals.append(float(np.sum(weight)))
    if not mixing:
        return transfers[0]
    return mix_channels(camera, np.array(transfers), np.array(signals), fx, fy, effects, place_um)[
        camera.channels.index(channel)
    ]


def common_wavelengths(
    camera: CameraModel,
    sights: Sequence[tuple[str, Spectrum | None]],
    effects: Sequence[Acts] = (),
    kind: str = "slanted_edge",
    count: int = OTF_WAVELENGTHS,
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm), at most `count`, that serve several sights (channel, light) at once, and how much each counts
    for each of them, (sights, wavelengths): sum 1 over a sight.

    Gauss's nodes for the sights' mean spectral weight without effects, so that transfers at the nodes are the same
    whatever effects do to the light's colours; with effects where these put light beside the nodes or let wavelengths
    land apart; the shares integrate the polynomial through the nodes, so that they may be below 0. Transfers of broad
    and narrow lights come out as by a sight's own nodes (2e-8 at 10 nodes; near a lens's cutoff, which is no polynomial
    in the wavelength, 5e-4).
    """
    spectra = _weigh_light(camera, sights, effects, kind)
    # what lets wavelengths land apart turns fast with the wavelength: at nodes of another light, ten are too few
    if effects and not image_of(camera, effects).moves:
        nodes = _pool_nodes(_weigh_light(camera, sights, (), kind), count)
        shares = np.concatenate([lagrange_shares(at, part[None], nodes) for at, part in spectra])
        if np.abs(shares).sum(axis=1).max() < MOST_SHARES:
            return nodes, shares
    nodes = _pool_nodes(spectra, count)
    return nodes, np.concatenate([lagrange_shares(at, part[None], nodes) for at, part in spectra])


def _pool_nodes(spectra: Sequence[tuple[FloatArray, FloatArray]], count: int) -> FloatArray:
    """Gauss's nodes for the mean weight of several sights; these have most of their wavelengths in common: each
    once.
    """
    position, which = np.unique(np.concatenate([at for at, _ in spectra]), return_inverse=True)
    pooled = np.bincount(which, np.concatenate([part for _, part in spectra])) / len(spectra)
    return gauss_rule(position, pooled, count)[0]


def wavelength_shares(
    camera: CameraModel,
    sights: Sequence[tuple[str, Spectrum | None]],
    wavelength_nm: FloatArray,
    effects: Sequence[Acts] = (),
    kind: str = "slanted_edge",
) -> FloatArray:
    """Return how much each of `wavelength_nm` (ascending) counts for each of several sights (channel, light) in a mean
    over the light that it detects, (sights, wavelengths), of what is linear between them: sum 1 over a sight."""
    spectra = _weigh_light(camera, sights, effects, kind)
    return np.array([linear_shares(at, part, wavelength_nm) for at, part in spectra])


def _weigh_light(
    camera: CameraModel, sights: Sequence[tuple[str, Spectrum | None]], effects: Sequence[Acts], kind: str
) -> list[tuple[FloatArray, FloatArray]]:
    """Compute the spectrum that each sight detects.

    Returns for each sight wavelengths (nm) and their weights, of sum 1. A sight without light has that of equal energy.
    """
    spectra = []
    for channel, radiance in sights:
        wavelength_nm, weight = detect_light(camera, channel, [(radiance, None)], effects, kind)
        spectra.append(otf_weight(camera, channel, wavelength_nm, weight[0]))
    return spectra


def transfer_at(
    camera: CameraModel,
    wavelength_nm: float,
    fx_cy_per_px: FloatArray,
    fy_cy_per_px: FloatArray,
    effects: Sequence[Acts] = (),
    *,
    place_um: tuple[float, float] = (0.0, 0.0),
    moving: bool = True,
) -> FloatArray | ComplexArray:
    """Transfer of lens, pixel and effects at one wavelength, of the broadcast shape of fx and fy (cy/px). `place_um`
    matters to path errors that change over the field; `moving` as in `Blur`.
    """
    blur = Blur(camera, effects, moving=moving)
    transfer = blur.at(wavelength_nm, fx_cy_per_px, fy_cy_per_px, place_um)
    return transfer * aperture_otf(fx_cy_per_px, fy_cy_per_px, camera.fill_factor)


def edge_profile(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    angle_deg: float,
    distance_px: ArrayLike,
    effects: Sequence[Acts] = (),
    kind: str = "slanted_edge",
    *,
    place_um: tuple[float, float] = (0.0, 0.0),
    collected: bool = False,
) -> FloatArray:
    """Compute the edge spread function of a straight edge as pixels see it: 0 on the dark side, 1 on the light side.

    distance_px : signed perpendicular distance d of the pixels from the edge (px), positive on the light side
    angle_deg : from the vertical; positive turns the top to the right
    place_um : the edge's place on the sensor, for path errors that change over the field

    ESF(d) = 1/2 + integral_0^inf [Re H sin(2 pi f d) + Im H cos(2 pi f d)] / (pi f) df, H the optical transfer function
    along the edge's normal (fx, fy) = f (cos angle, sin angle).
    """
    distance_px = np.asarray(distance_px, float)
    check_finite("distance from the edge", distance_px, "px")
    reach = max(64.0, 1.05 * float(np.max(np.abs(distance_px), initial=0.0)))
    # The integral becomes a sum over harmonics of a period that is long against the reach and against the tails.
    period = 16.0 * reach
    highest = _highest_cy_per_px(camera, channel, radiance, effects, kind)
    count = int(np.ceil(highest * period)) + 1
    f = np.arange(1, count) / period
    angle = np.deg2rad(angle_deg)
    transfer = optical_transfer(
        camera,
        channel,
        radiance,
        f * np.cos(angle),
        f * np.sin(angle),
        effects,
        kind,
        place_um=place_um,
        collected=collected,
    )
    samples = fft.next_fast_len(int(period * max(32.0, 4.0 * highest)), real=True)
    series = np.zeros(samples // 2 + 1, complex)
    series[1:count] = transfer / (2j * np.pi * np.arange(1, count))
    profile = fft.irfft(series, samples) * samples
    # The term at zero frequency is half of (2 d Re H + Im H' / pi) / period. Both are limits from above: a veil wider
    # than the period, a spike at zero frequency, lies even on both sides.
    ramp = float(np.real(2.0 * transfer[0] - transfer[1]))
    level = 0.5 + float(np.imag(transfer[0])) / (2.0 * np.pi)
    step = period / samples
    wing = int(np.ceil(reach / step)) + 4
    at = np.arange(-wing, wing + 1)
    table = CubicSpline(at * step, profile[at] + ramp * (at * step / period) + level)
    return np.asarray(table(distance_px))


def kernel(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    support: int,
    oversample: float = 1,
    effects: Sequence[Acts] = (),
    kind: str = "bernoulli",
) -> FloatArray:
    """Point spread function with the pixel's aperture, (support, support) samples of 1/oversample px, sum 1.

    A sample is the response of the middle pixel to light spread evenly over the sample's square: what light of that
    square does there. So the kernel convolves a picture drawn by area; element [half + i, half + j] is the answer i
    down and j to the right of the light. `support` is odd; `oversample` below 1 gives the coarse grid of a mosaic's
    plane (1/2).
    """
    if support < 1 or support % 2 == 0:
        raise ValueError(f"support {support} of the kernel has to be odd and at least 1: take {support + 1}")
    if not oversample > 0:
        raise ValueError(f"oversample {oversample} of the kernel has to be above 0: 1 gives samples of one pixel")
    highest = _highest_cy_per_px(camera, channel, radiance, effects, kind)
    # Sampled finely enough for the optics, then every `fine`-th sample is taken: coarse kernels alias as a mosaic does.
    fine = max(1, int(np.ceil(2.0 * min(highest, 8.0) / oversample)))
    size = fft.next_fast_len(max(4 * support, 64)) * fine
    fy = fft.fftfreq(size, 1.0 / (oversample * fine))
    fx = fft.rfftfreq(size, 1.0 / (oversample * fine))
    transfer = optical_transfer(camera, channel, radiance, fx[None, :], fy[:, None], effects, kind)
    square = np.sinc(fx / oversample)[None, :] * np.sinc(fy / oversample)[:, None]
    spread = fft.irfft2(transfer * square, (size, size))[::fine, ::fine]
    half = support // 2
    psf = np.roll(spread, (half, half), axis=(0, 1))[:support, :support]
    return psf / np.sum(psf)


def _highest_cy_per_px(
    camera: CameraModel, channel: str, radiance: Spectrum | None, effects: Sequence[Acts], kind: str
) -> float:
    """Return the lens's cutoff at the shortest wavelength that counts."""
    wavelength_nm, weight = detect_light(camera, channel, [(radiance, None)], effects, kind)
    nodes, _ = otf_wavelengths(camera, channel, wavelength_nm, weight[0], OTF_WAVELENGTHS)
    cutoff = camera.pixel_pitch_um * camera.lens.imaging.cutoff_cy_per_um(float(np.min(nodes)), camera.lens.f_number)
    return min(cutoff, HIGHEST_CY_PER_PX)
