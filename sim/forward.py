"""The one forward model: how light becomes a raw frame. Only composition; every stage stands in its own module.

    radiance -> (effects on the rig) -> lens: irradiance factor, transmittance, cos^4 -> optical transfer (diffraction, pixel
    aperture, effects) -> quantum efficiency by mosaic -> electrons + dark current -> (effects on charge) -> shot noise, full
    well -> (effects on the read-out) -> read noise, gain, black level -> codes

An effect acts through the hooks of `sim.effects.base.Effect`; without effects, or with effects at their absent values, the
result is the baseline bit for bit. Frequencies are cy/px, fx along columns (to the right), fy along rows (down).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial, reduce
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates

from sim.camera import CameraModel
from sim.effects.aberration import Aberration
from sim.effects.base import Effect
from sim.optics.diffraction import aperture_otf
from sim.optics.illumination import irradiance_factor, optical_axis_px, relative_illumination
from sim.optics.illumination import sin_theta as sin_theta_at
from sim.optics.imaging import DiffractionLimited, TracedLens
from sim.optics.pupil import Wavefront
from sim.optics.table import LensTable
from sim.scene.render import Drawing, Grid, Layer, Light, cell_means, draw
from sim.scene.scenes import Darkness, KnifeEdge, PosedEdges, Scene, ScreenPattern, SpectralImage, UniformField
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.sensor.electrons import FixedPattern, ReadOut
from sim.spectrum import (
    FloatArray,
    Spectrum,
    gauss_rule,
    lagrange_shares,
    linear_shares,
    photons_from_energy,
    quadrature,
)

ComplexArray = NDArray[np.complex128]

#: Wavelengths at which an optical transfer function is averaged over light and sensitivity (Gauss's rule for that weight):
#: within 1e-4 of a 1 nm sum, and for whole frames within 1e-3 near the cutoff, where little contrast is left.
OTF_WAVELENGTHS = 10
FRAME_WAVELENGTHS = 5

#: Share of the strongest picture's light below which a picture of a traced lens's scene is left out.
LEAST_SHARE = 1e-4

#: Frequencies beyond which an edge's profile isn't followed: 64 cy/px, where a pixel's aperture passes < 0.5 %.
HIGHEST_CY_PER_PX = 64.0


@dataclass(frozen=True)
class Exposure:
    """One exposure of a scene. `gain_db` is the analogue gain; `elapsed_s` the time after the session's first capture. Effects
    may depend on it and on the sensor's `temperature_c`, with which the dark current doubles as the camera model says.
    `magnification` of the scene dims the image as in ISET: pi / (1 + 4 N^2 (1 + |m|)^2); its blur stays that of `Lens.f_number`.
    `placed` matters to traced lenses, whose distortion moves the light: a scene's px are those of the ideal camera, or those of
    the image (a recording's corners), where the distortion is in them already."""

    scene: Scene
    exposure_s: float
    gain_db: float = 0.0
    temperature_c: float | None = None
    elapsed_s: float = 0.0
    magnification: float = 0.0
    placed: Literal["ideal", "image"] = "ideal"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.exposure_s) and self.exposure_s >= 0):
            raise ValueError(f"exposure {self.exposure_s} s is below the limit of 0 s or not finite: give seconds")


def responsivity(
    camera: CameraModel,
    channel: str,
    wavelength_nm: ArrayLike,
    effects: Sequence[Effect] = (),
    sin_theta: ArrayLike = 0.0,
) -> FloatArray:
    """Electrons per photon that would arrive at the image behind a lossless lens, by wavelength (nm).

    QE(wavelength) x lens transmittance x the effects' transmittance at the chief ray's `sin_theta`, which broadcasts against
    `wavelength_nm`. Raises ValueError for a channel the camera doesn't have.
    """
    wavelength_nm = np.asarray(wavelength_nm, float)
    value = _efficiency(camera, channel).at(wavelength_nm) * camera.lens.transmittance
    for effect in effects:
        value = value * effect.transmittance(wavelength_nm, np.asarray(sin_theta, float))
    return value


def electron_rate(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum,
    effects: Sequence[Effect] = (),
    kind: str = "flat",
    sin_theta: float = 0.0,
    *,
    reflectance: Spectrum | None = None,
    magnification: float = 0.0,
) -> float:
    """Electrons a second of one pixel of `channel` on axis, in a uniform field of `radiance` (W sr^-1 m^-2 nm^-1).

    pi / (1 + 4 N^2 (1 + |m|)^2) x pitch^2 x fill_factor x integral of radiance x wavelength / (h c) x responsivity. `kind` is
    the capture's, for effects on the rig. Off axis, `sin_theta` only enters the effects' transmittance: multiply by
    `sim.optics.illumination.relative_illumination` for the fall-off. `reflectance` stands for a chart's patch under a light
    whose radiance on a perfect diffuser is `radiance`. Raises ValueError for radiance below 0.
    """
    _, weight = _detected(camera, channel, [(radiance, reflectance)], effects, kind, sin_theta)
    return float(np.sum(weight)) * _collection_m2_sr(camera, magnification)


def optical_transfer(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    fx_cy_per_px: ArrayLike,
    fy_cy_per_px: ArrayLike,
    effects: Sequence[Effect] = (),
    kind: str = "slanted_edge",
    *,
    reflectance: Spectrum | None = None,
) -> ComplexArray:
    """Optical transfer function of one channel, 1 at zero frequency; complex, of the broadcast shape of fx and fy (cy/px).

    The average of the lens's transfer (`Lens.imaging`) x the effects', weighted by the detected electrons (light x responsivity) over
    wavelength, times the pixel's aperture. `radiance` None: light of equal energy at every wavelength.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_px, float), np.asarray(fy_cy_per_px, float))
    wavelength_nm, weight = _detected(camera, channel, [(radiance, reflectance)], effects, kind)
    nodes, share = _otf_wavelengths(camera, channel, wavelength_nm, weight[0], OTF_WAVELENGTHS)
    total: FloatArray | ComplexArray = np.zeros(fx.shape)
    for node, part in zip(nodes, share, strict=True):
        total = total + part * _transfer_at(camera, float(node), fx, fy, effects)
    return np.asarray(total * aperture_otf(fx, fy, camera.fill_factor), complex)


def common_wavelengths(
    camera: CameraModel,
    sights: Sequence[tuple[str, Spectrum | None]],
    effects: Sequence[Effect] = (),
    kind: str = "slanted_edge",
    count: int = OTF_WAVELENGTHS,
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm), at most `count`, that serve several sights (channel, light) at once, and how much each counts for each
    of them, (sights, wavelengths): sum 1 over a sight.

    Gauss's nodes for the sights' mean spectral weight; the shares integrate the polynomial through the nodes, so that they may be
    below 0. Transfers of broad and narrow lights come out as by a sight's own nodes (2e-8 at 10 nodes; near a lens's
    cutoff, which is no polynomial in the wavelength, 5e-4).
    """
    found = _seen_light(camera, sights, effects, kind)
    # sights have most of their wavelengths in common: each once
    position, which = np.unique(np.concatenate([at for at, _ in found]), return_inverse=True)
    pooled = np.bincount(which, np.concatenate([part for _, part in found])) / len(found)
    nodes, _ = gauss_rule(position, pooled, count)
    return nodes, np.concatenate([lagrange_shares(at, part[None], nodes) for at, part in found])


def wavelength_shares(
    camera: CameraModel,
    sights: Sequence[tuple[str, Spectrum | None]],
    wavelength_nm: FloatArray,
    effects: Sequence[Effect] = (),
    kind: str = "slanted_edge",
) -> FloatArray:
    """How much each of `wavelength_nm` (ascending) counts for each of several sights (channel, light) in a mean over the light that it
    detects, (sights, wavelengths), of what is linear between them: sum 1 over a sight."""
    seen = _seen_light(camera, sights, effects, kind)
    return np.array([linear_shares(at, part, wavelength_nm) for at, part in seen])


def _seen_light(
    camera: CameraModel, sights: Sequence[tuple[str, Spectrum | None]], effects: Sequence[Effect], kind: str
) -> list[tuple[FloatArray, FloatArray]]:
    """Of each sight, wavelengths (nm) and how much each counts, sum 1; a sight without light is that of equal energy."""
    found = []
    for channel, radiance in sights:
        wavelength_nm, weight = _detected(camera, channel, [(radiance, None)], effects, kind)
        found.append(_otf_weight(camera, channel, wavelength_nm, weight[0]))
    return found


def transfer_at(
    camera: CameraModel,
    wavelength_nm: float,
    fx_cy_per_px: FloatArray,
    fy_cy_per_px: FloatArray,
    effects: Sequence[Effect] = (),
) -> FloatArray | ComplexArray:
    """Transfer of lens, effects and pixel at one wavelength, of the broadcast shape of fx and fy (cy/px)."""
    transfer = _transfer_at(camera, wavelength_nm, fx_cy_per_px, fy_cy_per_px, effects)
    return transfer * aperture_otf(fx_cy_per_px, fy_cy_per_px, camera.fill_factor)


def edge_profile(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    angle_deg: float,
    distance_px: ArrayLike,
    effects: Sequence[Effect] = (),
    kind: str = "slanted_edge",
) -> FloatArray:
    """What a pixel at signed perpendicular distance d (px, positive on the light side) from a straight edge sees: 0..1.

    ESF(d) = 1/2 + integral_0^inf [Re H sin(2 pi f d) + Im H cos(2 pi f d)] / (pi f) df, H the optical transfer function along
    the edge's normal (fx, fy) = f (cos angle, sin angle); angle from the vertical, positive turns the top to the right.
    """
    distance_px = np.asarray(distance_px, float)
    _check_finite("distance from the edge", distance_px, "px")
    reach = max(64.0, 1.05 * float(np.max(np.abs(distance_px), initial=0.0)))
    # The integral becomes a sum over harmonics of a period that is long against the reach and against the tails.
    period = 16.0 * reach
    highest = _highest_cy_per_px(camera, channel, radiance, effects, kind)
    count = int(np.ceil(highest * period)) + 1
    f = np.arange(1, count) / period
    angle = np.deg2rad(angle_deg)
    transfer = optical_transfer(camera, channel, radiance, f * np.cos(angle), f * np.sin(angle), effects, kind)
    samples = fft.next_fast_len(int(period * max(32.0, 4.0 * highest)), real=True)
    series = np.zeros(samples // 2 + 1, complex)
    series[1:count] = transfer / (2j * np.pi * np.arange(1, count))
    profile = fft.irfft(series, samples) * samples
    # The term at zero frequency is half of (2 d Re H + Im H' / pi) / period. Both are limits from above: a veil wider than
    # the period, a spike at zero frequency, lies even on both sides.
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
    effects: Sequence[Effect] = (),
    kind: str = "bernoulli",
) -> FloatArray:
    """Point spread function with the pixel's aperture, (support, support) samples of 1/oversample px, sum 1.

    A sample is the response of the middle pixel to light spread evenly over the sample's square: what light of that square
    does there. So the kernel convolves a picture drawn by area; element [half + i, half + j] is the answer i down and j to the
    right of the light. `support` is odd; `oversample` below 1 gives the coarse grid of a mosaic's plane (1/2).
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


def expected_electrons(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> FloatArray:
    """Mean electrons (rows, cols) of every pixel, light and dark current, after the effects on charge; not yet clipped.

    Scenes that aren't uniform or straight edges are drawn by area on `oversample` x `oversample` samples a pixel, with
    `margin_px` around the frame, and blurred channel by channel with the channel's transfer function. The light beyond the
    margin is taken as the scene's other end. On random cells of 2 px at f/4 and 3 um pixels, 2, 3, 4, 6 samples a pixel leave
    0.6, 0.2, 0.1, 0.05 % of white rms; a frame of 480 x 640 takes 0.5, 1.1, 2.4 s of one core at 2, 3, 4.
    """
    check_overlap(camera, exposure.scene)
    light = scene_light(
        camera, exposure.scene, effects, oversample=oversample, margin_px=margin_px, placed=exposure.placed
    )
    return collected_electrons(light, camera, exposure, effects)


def check_overlap(camera: CameraModel, scene: Scene) -> None:
    """Raises ValueError for a scene that sheds light, none of which any channel can see: most likely a unit was mistaken."""
    lights = [value for item in vars(scene).values() for value in (item if isinstance(item, tuple) else (item,))]
    spectra = [light for light in lights if isinstance(light, Spectrum)]
    if isinstance(scene, SpectralImage):
        brightest = np.max(scene.radiance.reshape(-1, scene.radiance.shape[2]), axis=0)
        spectra = [Spectrum.of(scene.wavelength_nm, brightest)]
    shining = [light for light in spectra if max(light.value) > 0]
    seen = [_span_nm([_efficiency(camera, channel)]) for channel in camera.channels]
    lit = _span_nm(shining)
    if shining and all(min(high, lit[1]) <= max(low, lit[0]) for low, high in seen):
        low, high = min(span[0] for span in seen), max(span[1] for span in seen)
        raise ValueError(
            f"the scene's light lies at {lit[0]:g} to {lit[1]:g} nm, outside the limits {low:g} to {high:g} nm of the quantum efficiency: give wavelengths in nm, or a curve that reaches the light"
        )


def _span_nm(curves: Sequence[Spectrum]) -> tuple[float, float]:
    """Between which wavelengths any of some curves is above 0."""
    low, high = np.inf, -np.inf
    for curve in curves:
        wavelength_nm, value = curve.arrays
        above = np.flatnonzero(value > 0)
        if above.size:
            low = min(low, float(wavelength_nm[max(above[0] - 1, 0)]))
            high = max(high, float(wavelength_nm[min(above[-1] + 1, value.size - 1)]))
    return low, high


def check_not_saturated(camera: CameraModel, exposure: Exposure, electrons: FloatArray) -> None:
    """Raises ValueError where an exposure saturates every pixel: nothing of the scene would be left in the frame.

    `electrons`: of `expected_electrons`. The limit is the full well, or what the converter reads at the gain. (The physics of
    clipping is in `expected` and `sample` all the same: whoever simulates calls this first.)
    """
    limit = sensor.capacity_e(camera, exposure.gain_db)
    darkest = float(np.min(electrons))
    if darkest >= limit:
        raise ValueError(
            f"exposure {exposure.exposure_s:g} s saturates all pixels: the darkest collects {darkest:.4g} e, and the limit is {limit:.4g} e at {exposure.gain_db:g} dB; expose {0.5 * exposure.exposure_s * limit / darkest:.2g} s, lower the gain or dim the light"
        )


def dark_electrons(camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = ()) -> FloatArray | float:
    """Mean electrons of the dark current in one exposure, at its temperature; (rows, cols) where effects tell pixels apart."""
    rate: FloatArray | float = sensor.dark_current_e_per_s(camera, exposure.temperature_c)
    for effect in effects:
        rate = effect.dark_current(rate, exposure.temperature_c, camera)
    return rate * exposure.exposure_s


def moments(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> tuple[FloatArray, FloatArray]:
    """`expected` (DN) and `variance` (DN^2) at the price of one."""
    electrons = expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px)
    return sensor.dn_moments(electrons, camera, exposure.gain_db, read_out(camera, exposure, effects))


def expected(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> FloatArray:
    """Mean frame (rows, cols) in DN of a camera whose pixels are all alike; clipping and rounding are averaged over noise."""
    return moments(camera, exposure, effects, oversample=oversample, margin_px=margin_px)[0]


def variance(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 3, margin_px: int = 32
) -> FloatArray:
    """Temporal variance (rows, cols) in DN^2: shot, read and row noise, the effects' own, clipping, and rounding."""
    return moments(camera, exposure, effects, oversample=oversample, margin_px=margin_px)[1]


def sample(
    camera: CameraModel,
    exposure: Exposure,
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
    fixed_pattern: FixedPattern | None = None,
    *,
    oversample: int = 3,
    margin_px: int = 32,
) -> NDArray[np.uint16]:
    """One raw frame (rows, cols) drawn from the model. `fixed_pattern` None: pixels that are all alike.

    For many frames of one scene take `expected_electrons` once and draw with `sim.sensor.electrons.sample_from`.
    """
    return sensor.sample_from(
        expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px),
        camera,
        rng,
        fixed_pattern,
        dark_electrons=dark_electrons(camera, exposure, effects),
        gain_db=exposure.gain_db,
        read_out=read_out(camera, exposure, effects),
    )


def expected_sequence(
    camera: CameraModel,
    exposures: Iterable[Exposure],
    effects: Sequence[Effect] = (),
    *,
    oversample: int = 3,
    margin_px: int = 32,
) -> Iterator[FloatArray]:
    """Mean electrons (rows, cols) that are read in each exposure of a sequence, one after the other: what a frame leaves
    behind (`Effect.left_behind`) is read with the next. The first follows empty pixels; an exposure that is the same object
    as the one before is drawn once.

    Drawing every frame's electrons from these means on their own is exact: of Poisson electrons that are told apart one by
    one, those read and those left behind are independent Poisson variables.
    """
    before: Exposure | None = None
    new: FloatArray = np.zeros(())
    left: FloatArray | float = 0.0
    for exposure in exposures:
        if exposure is not before:
            new = expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px)
            before = exposure
        read, left = read_electrons(new + left, camera, effects)
        yield read


def sample_sequence(
    camera: CameraModel,
    exposures: Iterable[Exposure],
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
    fixed_pattern: FixedPattern | None = None,
    *,
    oversample: int = 3,
    margin_px: int = 32,
) -> Iterator[NDArray[np.uint16]]:
    """Raw frames (rows, cols) of exposures taken one after the other, drawn as `sample` does from `expected_sequence`."""
    every = list(exposures)
    means = expected_sequence(camera, every, effects, oversample=oversample, margin_px=margin_px)
    for exposure, electrons in zip(every, means, strict=True):
        yield sensor.sample_from(
            electrons,
            camera,
            rng,
            fixed_pattern,
            dark_electrons=dark_electrons(camera, exposure, effects),
            gain_db=exposure.gain_db,
            read_out=read_out(camera, exposure, effects),
        )


def read_out(camera: CameraModel, exposure: Exposure, effects: Sequence[Effect]) -> ReadOut:
    """What the effects make of the read-out: their responses, noise and offsets, one after the other."""
    if not effects:
        return sensor.LINEAR

    def response(electrons: FloatArray) -> FloatArray:
        for effect in effects:
            electrons = effect.response(electrons, camera)
        return electrons

    def noise_e2(electrons: FloatArray, noise: FloatArray) -> FloatArray:
        for effect in effects:
            noise = effect.noise_e2(electrons, noise, camera)
        return noise

    def added(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        drawn = (effect.added(shape, rng, camera) for effect in effects)
        return sum((more for more in drawn if more is not None), np.zeros((1, 1)))

    def codes(dn: FloatArray) -> FloatArray:
        for effect in effects:
            dn = effect.codes(dn, camera)
        return dn

    def neighbours(electrons: FloatArray) -> FloatArray:
        return np.asarray(sum((effect.neighbour_correlation(electrons, camera) for effect in effects), 0.0))

    def overridden(hook: str) -> bool:
        return any(getattr(type(effect), hook) is not getattr(Effect, hook) for effect in effects)

    # Only what is overridden acts, so that effects elsewhere leave the read-out the baseline's to the last bit.
    shape = camera.rows, camera.cols
    return ReadOut(
        response if overridden("response") else None,
        noise_e2 if overridden("noise_e2") else None,
        sum(effect.offset_dn(exposure.elapsed_s, exposure.temperature_c, camera) for effect in effects),
        added if overridden("added") else None,
        sum((effect.added_e(shape, camera) for effect in effects), 0.0),
        sum((effect.added_e2(shape, camera) for effect in effects), 0.0),
        codes if overridden("codes") else None,
        neighbours if overridden("neighbour_correlation") else None,
        processing_kernel(camera, effects),
    )


def processing_kernel(camera: CameraModel, effects: Sequence[Effect]) -> FloatArray | None:
    """Kernel of all filters that the effects run over each colour's plane, one after the other; None for none."""
    kernels = [kernel for effect in effects if (kernel := effect.processing(camera)) is not None]
    if len(kernels) > 1:
        from scipy.signal import convolve2d  # here: the library takes a while to load

        return np.asarray(reduce(convolve2d, kernels))
    return kernels[0] if kernels else None


# --- parts -----------------------------------------------------------------------------------------------------------


def _efficiency(camera: CameraModel, channel: str) -> Spectrum:
    if channel not in camera.channels or channel not in camera.quantum_efficiency:
        raise ValueError(
            f"channel {channel!r} has no quantum efficiency in this {camera.cfa} camera (known: {', '.join(camera.quantum_efficiency)}): add the curve or ask for another channel"
        )
    return camera.quantum_efficiency[channel]


def _collection_m2_sr(camera: CameraModel, magnification: float = 0.0) -> float:
    """Radiance to a pixel's flux: irradiance factor x light-sensitive area."""
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2 * camera.fill_factor
    return irradiance_factor(camera.lens.f_number, magnification) * area_m2


def _detected(
    camera: CameraModel,
    channel: str,
    lights: Sequence[Light],
    effects: Sequence[Effect],
    kind: str,
    sin_theta: FloatArray | float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and electrons detected at each: photons s^-1 m^-2 sr^-1 x responsivity x quadrature weight.

    The second is (lights, wavelengths), or (angles, lights, wavelengths) where `sin_theta` is (angles,).
    """
    curves = (curve for light in lights for curve in light if curve is not None)
    wavelength_nm, width = _rule(_efficiency(camera, channel), *curves)
    seen: dict[int, FloatArray] = {}
    rows = []
    for radiance, reflectance in lights:
        if id(radiance) not in seen:
            light = np.ones_like(wavelength_nm) if radiance is None else radiance.at(wavelength_nm)
            for effect in effects:
                light = effect.radiance(wavelength_nm, light, kind)
            _check_radiance(wavelength_nm, light)
            seen[id(radiance)] = light
        light = seen[id(radiance)]
        rows.append(light if reflectance is None else light * reflectance.at(wavelength_nm))
    angles = np.asarray(sin_theta, float)[..., None, None]
    factor = responsivity(camera, channel, wavelength_nm, effects, angles) * width
    return wavelength_nm, photons_from_energy(wavelength_nm, np.stack(rows)) * factor


@lru_cache(maxsize=256)
def _rule(*curves: Spectrum) -> tuple[FloatArray, FloatArray]:
    """`quadrature` of curves that whoever changes the effects asks for again."""
    rule = quadrature(curves)
    for part in rule:
        part.flags.writeable = False
    return rule


def _check_radiance(wavelength_nm: FloatArray, radiance: FloatArray) -> None:
    lowest = int(np.argmin(np.where(np.isfinite(radiance), radiance, -np.inf)))
    if not (radiance[lowest] >= 0 and np.isfinite(radiance[lowest])):
        raise ValueError(
            f"radiance is {radiance[lowest]:g} W sr^-1 m^-2 nm^-1 at {wavelength_nm[lowest]:g} nm, below the limit of 0 or not finite: subtract the radiometer's dark reading, and set what stays below 0 to 0"
        )


def _check_finite(what: str, value: FloatArray, unit: str) -> None:
    if not np.all(np.isfinite(value)):
        bad = value[~np.isfinite(value)].flat[0]
        raise ValueError(f"{what} is {bad} {unit}, and has to be a finite number: leave such points out")


def _otf_wavelengths(
    camera: CameraModel, channel: str, wavelength_nm: FloatArray, weight: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """A few wavelengths (nm) and shares (sum 1) over which to average the transfer function for detected light `weight`."""
    return gauss_rule(*_otf_weight(camera, channel, wavelength_nm, weight), count)


def _otf_weight(
    camera: CameraModel, channel: str, wavelength_nm: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and how much each counts (sum 1) in a transfer function, for detected light `weight`."""
    total = float(np.sum(weight))
    if not total > 0:
        # No light: any transfer function will do, and that of equal energy is the natural one.
        wavelength_nm, equal = _detected(camera, channel, [(None, None)], (), "flat")
        weight, total = equal[0], float(np.sum(equal))
    if not total > 0:
        raise ValueError(
            f"quantum efficiency x lens transmittance of channel {channel!r} is 0 everywhere: give a curve above 0"
        )
    return wavelength_nm, weight / total


def _highest_cy_per_px(
    camera: CameraModel, channel: str, radiance: Spectrum | None, effects: Sequence[Effect], kind: str
) -> float:
    """The lens's cutoff at the shortest wavelength that counts."""
    wavelength_nm, weight = _detected(camera, channel, [(radiance, None)], effects, kind)
    nodes, _ = _otf_wavelengths(camera, channel, wavelength_nm, weight[0], OTF_WAVELENGTHS)
    cutoff = camera.pixel_pitch_um * camera.lens.imaging.cutoff_cy_per_um(float(np.min(nodes)), camera.lens.f_number)
    return min(cutoff, HIGHEST_CY_PER_PX)


def _transfer_at(
    camera: CameraModel, wavelength_nm: float, fx: FloatArray, fy: FloatArray, effects: Sequence[Effect]
) -> FloatArray | ComplexArray:
    """The lens's transfer, with all aberrations in its pupil, x the other effects' at one wavelength; fx, fy in cy/px, which
    broadcast."""
    fx_um, fy_um = fx / camera.pixel_pitch_um, fy / camera.pixel_pitch_um
    aberration = Wavefront(())
    for effect in effects:
        if isinstance(effect, Aberration):
            aberration += effect.wavefront(wavelength_nm, camera)
    value = camera.lens.imaging.transfer(fx_um, fy_um, wavelength_nm, camera.lens.f_number, aberration)
    for effect in effects:
        if isinstance(effect, Aberration):
            continue
        factor = effect.transfer(fx_um, fy_um, wavelength_nm, camera)
        if factor is not None:
            value = value * factor
    return value


def _reflected(image: FloatArray, camera: CameraModel, effects: Sequence[Effect]) -> FloatArray:
    """A channel's image with what effects make of it as a whole. A traced lens's image is a mosaic already: colour by colour."""
    acting = [effect for effect in effects if type(effect).image is not Effect.image]
    if not acting:
        return image
    traced = isinstance(camera.lens.imaging, TracedLens)
    changed = image.copy()
    for plane in mosaic.planes(changed, camera.cfa).values() if traced else [changed]:
        for effect in acting:
            plane[:] = effect.image(plane, camera)
    return changed


def _plain_images(
    camera: CameraModel,
    scene: Scene,
    effects: Sequence[Effect],
    oversample: int,
    margin_px: int,
    transfers: KeptTransfers | None = None,
) -> dict[str, FloatArray]:
    """Electrons a second of every channel behind a lens that blurs alike everywhere, (rows, cols) each, before cos^4."""
    shape = camera.rows, camera.cols
    if isinstance(scene, UniformField):
        images = {c: _uniform_image(camera, c, scene, effects) for c in camera.channels}
    elif isinstance(scene, KnifeEdge):
        images = {c: _edge_image(camera, c, scene, effects) for c in camera.channels}
    elif isinstance(scene, PosedEdges):
        images = _posed_edge_images(camera, scene, effects)
    elif isinstance(scene, SpectralImage):
        images = _cube_images(camera, scene, effects, oversample, _margin_for(camera, effects, margin_px))
    else:
        grid = Grid(*shape, oversample, _margin_for(camera, effects, margin_px))
        images = _blurred_images(camera, scene, effects, grid, transfers)
    return images


def _traced_image(
    camera: CameraModel,
    table: LensTable,
    scene: Scene,
    effects: Sequence[Effect],
    oversample: int,
    margin_px: int,
    placed: str,
) -> FloatArray:
    """Electrons a second behind a traced lens: every pixel that of its own channel, (rows, cols).

    A sum over few pictures, each blurred channel by channel with the point spread functions of its light (summed over the
    table's wavelengths as it is detected). The effects' `transfer`, alike all over the frame, acts on the picture in the image
    before it is blurred: the two commute but for what the lens changes within the reach of the effect, some 1e-3 of the blur.
    """
    # here: the compiler's library takes a while to load
    from sim.optics.distorted import distort
    from sim.optics.field_mapping import ImageFrame, illumination, source_grid
    from sim.optics.field_mapping import margin_px as blur_margin_px
    from sim.optics.kernels import Kernels, Tile
    from sim.optics.superposition import superpose

    if _light_moves(camera, effects):
        raise ValueError(
            "an effect moves the light of a traced lens, which does that itself: leave distortion and lateral colour to the prescription, or image by another model"
        )
    axis = optical_axis_px(camera)
    frame = ImageFrame(camera.rows, camera.cols, camera.pixel_pitch_um, camera.fill_factor, axis)
    margin_px = max(margin_px, blur_margin_px(table, camera.pixel_pitch_um))
    target = Grid(camera.rows, camera.cols, oversample, margin_px)
    distorted = placed == "ideal"
    grid = source_grid(table, frame, oversample, margin_px) if distorted else target
    period, phases = mosaic.step(camera.cfa), mosaic.phases(camera.cfa)
    image = np.zeros((camera.rows, camera.cols))
    ground, over, pictures = _pictures_by_rank(camera, table, scene, effects, grid)
    for channel, light in zip(camera.channels, ground, strict=True):
        for row0, col0 in phases[channel]:
            image[row0::period, col0::period] += illumination(table, light, frame, (row0, col0), period)
    blurs = [effect for effect in _blurring(effects) if type(effect).transfer is not Effect.transfer]
    tiles: list[Tile] | None = None
    for weight, picture in zip(over, pictures, strict=True):
        imaged = distort(picture, grid, target, table, frame) if distorted else picture.astype(np.float32)
        # Without blurring effects one picture serves all channels.
        shared = [list(range(len(weight)))] if not blurs else [[k] for k in range(len(weight))]
        spectrum = fft.rfft2(imaged) if blurs else None
        for members in shared:
            kernels = Kernels(table, weight[members], frame, oversample, distorted=distorted)
            # The first picture, with most of the light, says how large tiles may be.
            tiles = kernels.tiles(target) if tiles is None else tiles
            seen = imaged
            if spectrum is not None:
                light = np.sum(weight[members[0]], axis=0)
                transfer = _effects_transfer(camera, table, light, blurs, target)
                seen = np.asarray(fft.irfft2(spectrum * transfer, imaged.shape), np.float32)
            superpose(seen, target, kernels, [phases[camera.channels[k]] for k in members], period, image, tiles)
    return np.maximum(image, 0.0)


def _pictures_by_rank(
    camera: CameraModel, table: LensTable, scene: Scene, effects: Sequence[Effect], grid: Grid
) -> tuple[FloatArray, FloatArray, Iterator[FloatArray]]:
    """A scene as an even ground (channels, F, W) and pictures on a grid with their lights (pictures, channels, F, W): the fewest
    that leave 1e-4 of the strongest's light."""
    if isinstance(scene, SpectralImage):
        rows, cols, bands = scene.radiance.shape
        lights: list[Light] = [(band, None) for band in scene.bands()]
        weight = _table_light(camera, table, lights, effects, scene.kind)
        flat = scene.radiance.reshape(-1, bands)
        # The spectra's own correlations make the rank smaller still: cube = (cube E) E^T with orthogonal pictures.
        energy, basis = np.linalg.eigh(flat.T.astype(float) @ flat if flat.dtype == float else _gram(flat))
        size = np.sqrt(np.maximum(energy, 0.0))
        u, strength, vt = np.linalg.svd(size[:, None] * (basis.T @ weight.reshape(bands, -1)), full_matrices=False)
        kept = strength > LEAST_SHARE * max(float(strength[0]), 1e-300)
        mix = basis @ (u[:, kept] / np.where(size > 0, size, 1.0)[:, None])
        over = (strength[kept, None] * vt[kept]).reshape(-1, *weight.shape[1:])
        drawn = (
            cell_means((flat @ column.astype(flat.dtype)).reshape(rows, cols).astype(float), scene.warp(), grid, 0.0)
            for column in mix.T
        )
        return np.zeros(weight.shape[1:]), over, drawn
    drawing = draw(scene, grid)
    lights = [drawing.ground, *(layer.light for layer in drawing.layers)]
    weight = _table_light(camera, table, lights, effects, scene.kind)
    layers = drawing.layers
    if len(layers) <= 1:
        return weight[0], weight[1:] - weight[0], (_on_grid(grid, layers, [1.0]) for _ in layers)
    u, strength, vt = np.linalg.svd((weight[1:] - weight[0]).reshape(len(layers), -1), full_matrices=False)
    kept = strength > LEAST_SHARE * max(float(strength[0]), 1e-300)
    over = (strength[kept, None] * vt[kept]).reshape(-1, *weight.shape[1:])
    return weight[0], over, (_on_grid(grid, layers, column.tolist()) for column in u[:, kept].T)


def _gram(flat: NDArray[np.floating]) -> FloatArray:
    """flat^T flat in double precision, without a copy of all of it."""
    total = np.zeros((flat.shape[1], flat.shape[1]))
    for start in range(0, len(flat), 65536):
        part = flat[start : start + 65536].astype(float)
        total += part.T @ part
    return total


def _on_grid(grid: Grid, layers: Sequence[Layer], factors: Sequence[float]) -> FloatArray:
    """The sum of factor x coverage of some layers."""
    if len(layers) == 1 and factors[0] == 1.0 and layers[0].coverage.shape == grid.shape:
        return layers[0].coverage
    total = np.zeros(grid.shape)
    for layer, factor in zip(layers, factors, strict=True):
        total[layer.window] += factor * layer.coverage
    return total


def _table_light(
    camera: CameraModel, table: LensTable, lights: Sequence[Light], effects: Sequence[Effect], kind: str
) -> FloatArray:
    """Electrons a second that each light gives every channel at every field and wavelength of a table, on an even field and
    without relative illumination: (lights, channels, F, W). Between the table's wavelengths its functions are linear."""
    radius_mm = np.hypot(*table.chief_mm.T)
    sine = radius_mm / np.hypot(radius_mm, table.focal_length_mm)
    out = np.empty((len(lights), len(camera.channels), sine.size, table.wavelength_nm.size))
    for k, channel in enumerate(camera.channels):
        wavelength_nm, weight = _detected(camera, channel, lights, effects, kind, sine)
        hats = [np.interp(wavelength_nm, table.wavelength_nm, unit) for unit in np.eye(table.wavelength_nm.size)]
        light = (weight @ np.stack(hats, axis=1)) * _collection_m2_sr(camera)
        # An angle makes a difference only where an effect says so: (F, lights, W), or (lights, W) for all fields.
        out[:, k] = np.moveaxis(np.broadcast_to(light, (sine.size, *light.shape[-2:])), 0, 1)
    return out


def _effects_transfer(
    camera: CameraModel, table: LensTable, light: FloatArray, effects: Sequence[Effect], grid: Grid
) -> NDArray[np.inexact]:
    """Product of the effects' transfers on a grid's frequencies, averaged over the table's wavelengths with `light` (W,)."""
    fy, fx, _, _ = _pixel_on_grid(camera, grid)
    share = np.abs(light) / max(float(np.sum(np.abs(light))), 1e-300)
    nodes, share = gauss_rule(table.wavelength_nm, share, FRAME_WAVELENGTHS)
    total: FloatArray | ComplexArray = np.zeros((fy.size, fx.size))
    for node, part in zip(nodes, share, strict=True):
        value: FloatArray | ComplexArray = np.full((fy.size, fx.size), part)
        for effect in effects:
            factor = effect.transfer(fx / camera.pixel_pitch_um, fy / camera.pixel_pitch_um, float(node), camera)
            if factor is not None:
                value = value * factor
        total = total + value
    return np.asarray(total, np.complex64 if np.iscomplexobj(total) else np.float32)


def _field_of_rates(
    camera: CameraModel, channel: str, lights: Sequence[Light], effects: Sequence[Effect], kind: str
) -> list[CubicSpline] | None:
    """Electron rates relative to the axis as functions of sin^2 of the chief ray's angle, one a light, where an effect's
    transmittance depends on the angle; None where none does."""
    if all(type(effect).transmittance is Effect.transmittance for effect in effects):
        return None
    corners = sin_theta_at(
        camera, np.array([0, 0, camera.rows - 1, camera.rows - 1]), np.array([0, camera.cols - 1] * 2)
    )
    square = np.linspace(0.0, float(np.max(corners)) ** 2, 17)
    _, weight = _detected(camera, channel, lights, effects, kind, np.sqrt(square))
    rate = np.sum(weight, axis=-1)
    if np.all(rate == rate[0]):
        return None
    relative = rate / np.where(rate[0] > 0, rate[0], 1.0)
    return [CubicSpline(square, column) for column in relative.T]


def _uniform_image(camera: CameraModel, channel: str, scene: UniformField, effects: Sequence[Effect]) -> FloatArray:
    image = np.full((camera.rows, camera.cols), electron_rate(camera, channel, scene.radiance, effects, scene.kind))
    field = _field_of_rates(camera, channel, [(scene.radiance, None)], effects, scene.kind)
    if field is not None:
        row, col = np.arange(camera.rows)[:, None], np.arange(camera.cols)[None, :]
        image *= field[0](sin_theta_at(camera, row, col) ** 2)
    return image


def _edge_image(camera: CameraModel, channel: str, scene: KnifeEdge, effects: Sequence[Effect]) -> FloatArray:
    """Straight edges need no drawing: every pixel takes the profile of the nearest region's edge at its own distance."""
    if not scene.regions:
        raise ValueError("a knife edge with no region shows nothing: give at least one edge region")
    row, col = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    away = []
    for edge in scene.regions:
        row0, col0, row1, col1 = edge.region
        down = np.maximum(np.maximum(row0 - row, row - (row1 - 1)), 0.0)
        across = np.maximum(np.maximum(col0 - col, col - (col1 - 1)), 0.0)
        away.append(np.hypot(down, across))
    owner = np.argmin(np.stack(away), axis=0)
    spectra = scene.dark_radiance, scene.light_radiance
    rates = [electron_rate(camera, channel, radiance, effects, scene.kind) for radiance in spectra]
    field = _field_of_rates(camera, channel, [(radiance, None) for radiance in spectra], effects, scene.kind)
    image = np.empty(row.shape)
    for index, edge in enumerate(scene.regions):
        mine = owner == index
        if not np.any(mine):
            continue
        dark, light = rates
        if field is not None:
            square = sin_theta_at(camera, row[mine], col[mine]) ** 2
            dark, light = dark * field[0](square), light * field[1](square)
        seen_row, seen_col, acting = row[mine], col[mine], _blurring(effects)
        if _light_moves(camera, effects):
            # by place as the channel's mean wavelength is moved; what others differ from that, alike over a region, blurs
            mean_nm = _mean_wavelength(camera, channel, scene.light_radiance, effects, scene.kind)
            seen_row, seen_col = _unmoved_px(camera, seen_row, seen_col, mean_nm, effects)
            row0, col0, row1, col1 = edge.region
            middle = 0.5 * (row0 + row1 - 1), 0.5 * (col0 + col1 - 1)
            acting = (*acting, _ShiftAt(acting=acting, row=middle[0], col=middle[1], less_at_nm=mean_nm))
        distance = edge.distance_px(seen_row, seen_col)
        dim, bright = (
            edge_profile(camera, channel, radiance, edge.angle_deg, distance, acting, scene.kind)
            for radiance in spectra
        )
        image[mine] = light * bright + dark * (1.0 - dim)
    return image


def _posed_edge_images(camera: CameraModel, scene: PosedEdges, effects: Sequence[Effect]) -> dict[str, FloatArray]:
    """Electrons a second of every channel, before cos^4: a pixel sees the profile of its edge at its own distance, and lens and
    perspective bend distance and slope along the edge. The transfer is that of the place where the edge's middle is seen."""
    moves = _light_moves(camera, effects)
    margin = _margin_for(camera, effects, 1)
    axes = [np.arange(-margin, n + margin, dtype=float) for n in (camera.rows, camera.cols)]
    owner, away_mm = scene.distances(*axes)
    slopes = [np.gradient(distance) for distance in away_mm]
    pixels = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    square = sin_theta_at(camera, *pixels) ** 2
    inner = slice(margin, margin + camera.rows), slice(margin, margin + camera.cols)
    spectra = scene.dark_radiance, scene.light_radiance
    images: dict[str, FloatArray] = {}
    for channel in camera.channels:
        place = None
        if moves:
            mean_nm = _mean_wavelength(camera, channel, scene.light_radiance, effects, scene.kind)
            place = np.stack(_unmoved_px(camera, pixels[0], pixels[1], mean_nm, effects)) + margin
        mine = owner[inner] if place is None else map_coordinates(owner, place, order=0, mode="nearest")
        rates = [electron_rate(camera, channel, radiance, effects, scene.kind) for radiance in spectra]
        field = _field_of_rates(camera, channel, [(radiance, None) for radiance in spectra], effects, scene.kind)
        image = np.empty((camera.rows, camera.cols))
        for index, (edge, distance, (down, across)) in enumerate(zip(scene.edges, away_mm, slopes, strict=True)):
            use = mine == index
            if not np.any(use):
                continue
            px = distance / np.hypot(down, across)
            seen = px[inner][use] if place is None else map_coordinates(px, place[:, use], order=3, mode="nearest")
            at = np.array([np.clip(float(v), 0.0, n - 1.0) for v, n in zip(scene.warp().to_camera(*edge.centre_mm), (camera.rows, camera.cols), strict=True)])  # fmt: skip
            near = tuple(np.rint(at).astype(int) + margin)
            angle_deg = float(np.rad2deg(np.arctan2(down[near], across[near])))
            from_centre_um = (at - 0.5 * (np.array([camera.rows, camera.cols]) - 1.0)) * camera.pixel_pitch_um
            acting = tuple(
                e.at_place(float(from_centre_um[1]), float(from_centre_um[0]), camera) for e in _blurring(effects)
            )
            if moves:
                acting = (*acting, _ShiftAt(acting=acting, row=float(at[0]), col=float(at[1]), less_at_nm=mean_nm))
            profiles = [edge_profile(camera, channel, scene.light_radiance, angle_deg, seen, acting, scene.kind)]
            if not _alike(*spectra):
                profiles.append(edge_profile(camera, channel, scene.dark_radiance, angle_deg, seen, acting, scene.kind))
            dark, light = rates[0] * np.ones(1), rates[1] * np.ones(1)
            if field is not None:
                dark, light = dark * field[0](square[use]), light * field[1](square[use])
            image[use] = light * profiles[0] + dark * (1.0 - profiles[-1])
        images[channel] = np.maximum(image, 0.0)
    return images


def _alike(one: Spectrum, other: Spectrum) -> bool:
    """Whether two lights have the same colour."""
    (w, a), (x, b) = one.arrays, other.arrays
    return (
        w.shape == x.shape and bool(np.all(w == x)) and np.allclose(a * np.sum(b), b * np.sum(a), rtol=1e-9, atol=0.0)
    )


def _blurred_images(
    camera: CameraModel, scene: Scene, effects: Sequence[Effect], grid: Grid, kept: KeptTransfers | None = None
) -> dict[str, FloatArray]:
    """Electrons a second (rows, cols) of every channel, of a scene drawn by area and convolved, before cos^4.

    With OTF_k at a few wavelengths, w_lk the share of light l's electrons that goes with each, and F the Fourier transform,
    the image is sum_k OTF_k F[sum_l w_lk picture_l]. The ground's picture is 1 minus all others', so that only the
    differences to the ground are transformed. `kept`: transfers of scenes before in the same lights, and those of this one.
    """
    drawing = draw(scene, grid)
    if isinstance(scene, ScreenPattern):
        drawing = _shown(drawing, grid, camera, effects)
    lights: list[Light] = [drawing.ground, *(layer.light for layer in drawing.layers)]
    m = grid.margin_px
    ny, nx = grid.shape
    fy, fx, pixel_y, pixel_x = _pixel_on_grid(camera, grid)
    images: dict[str, FloatArray] = {}
    moves = _light_moves(camera, effects)
    transformed: list[ComplexArray] = []
    for channel in camera.channels:
        wavelength_nm, weight = _detected(camera, channel, lights, effects, scene.kind)
        weight = weight * _collection_m2_sr(camera)
        nodes, _ = _otf_wavelengths(camera, channel, wavelength_nm, np.sum(weight, axis=0), FRAME_WAVELENGTHS)
        shares = lagrange_shares(wavelength_nm, weight, nodes)
        field = _field_of_rates(camera, channel, lights, effects, scene.kind)
        pictures = [layer.coverage for layer in drawing.layers]
        # lights of one colour change alike over the field
        apart = field is not None and any(not np.allclose(f.c, field[0].c, rtol=0.0, atol=1e-12) for f in field)
        if field is not None and apart:
            pictures = [
                picture * _relative_to_ground(camera, grid, layer.window, field[index], field[0])
                for index, (layer, picture) in enumerate(zip(drawing.layers, pictures, strict=True), 1)
            ]
        windows = [layer.window for layer in drawing.layers]
        # Few pictures are transformed one by one, once for all channels; of many, one sum a wavelength.
        few = len(pictures) <= nodes.size
        if few and (apart or not transformed):
            transformed = [_transform(grid, [w], [p], [1.0]) for w, p in zip(windows, pictures, strict=True)]
        over = shares[1:] - shares[0]

        if few and not moves:
            key = (channel, nodes.tobytes(), over.tobytes(), grid)
            make = partial(_layer_transfers, camera, nodes, over, grid, effects)
            spectrum = np.zeros((ny, nx // 2 + 1), complex)
            acting: Sequence[NDArray[np.complexfloating[Any]]] = make() if kept is None else kept.get(key, make)
            for transfer, picture in zip(acting, transformed, strict=True):
                spectrum += transfer * picture
            image = _at_pixels(spectrum, grid.oversample, nx)[m : m + grid.rows, m : m + grid.cols]
        else:
            spectrum = np.zeros((ny, nx // 2 + 1), complex)
            image = np.zeros((grid.rows, grid.cols))
            for node, factors in zip(nodes, over.T.tolist(), strict=True):
                part = _transfer_at(camera, float(node), fx, fy, _blurring(effects)) * (pixel_x * pixel_y)
                part = part * (
                    _mixed(transformed, factors)
                    if few and transformed
                    else _transform(grid, windows, pictures, factors)
                )
                if moves:
                    image = image + _at_moved_pixels(camera, part, grid, float(node), effects)
                else:
                    spectrum += part
            if not moves:
                image = _at_pixels(spectrum, grid.oversample, nx)[m : m + grid.rows, m : m + grid.cols]
        image = np.maximum(image + np.sum(weight[0]), 0.0)
        if field is not None:
            row, col = np.arange(camera.rows)[:, None], np.arange(camera.cols)[None, :]
            image *= field[0](sin_theta_at(camera, row, col) ** 2)
        images[channel] = image
    return images


def _layer_transfers(
    camera: CameraModel, nodes: FloatArray, over: FloatArray, grid: Grid, effects: Sequence[Effect]
) -> list[ComplexArray]:
    """What the transform of each layer's picture is multiplied with: sum_k over_lk OTF_k at the nodes (nm), with the pixel."""
    fy, fx, pixel_y, pixel_x = _pixel_on_grid(camera, grid)
    total = np.zeros((len(over), fy.size, fx.size), complex)
    for node, factors in zip(nodes, over.T, strict=True):
        transfer = _transfer_at(camera, float(node), fx, fy, _blurring(effects))
        for index, factor in enumerate(factors):
            total[index] += factor * transfer
    return [part * pixel_x * pixel_y for part in total]


def _mixed(transformed: Sequence[ComplexArray], factors: Sequence[float]) -> ComplexArray:
    total = np.zeros_like(transformed[0])
    for factor, picture in zip(factors, transformed, strict=True):
        total += factor * picture
    return total


def _shown(drawing: Drawing, grid: Grid, camera: CameraModel, effects: Sequence[Effect]) -> Drawing:
    """A screen's pattern as the screen shows it, given what was asked for."""
    acting = [effect for effect in effects if type(effect).screen is not Effect.screen]
    if not acting:
        return drawing
    row, col = grid.axes_px()
    y_um = (row[:, None] - 0.5 * (camera.rows - 1)) * camera.pixel_pitch_um
    x_um = (col[None, :] - 0.5 * (camera.cols - 1)) * camera.pixel_pitch_um
    (lit,) = drawing.layers
    share = lit.coverage
    for effect in acting:
        share = effect.screen(share, x_um, y_um, camera)
    return replace(drawing, layers=(replace(lit, coverage=share),))


def _blurring(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects whose `transfer` acts on a whole frame: all but those that do the same to its charge or its codes."""
    return tuple(effect for effect in effects if not effect.acts_on_frames())


def _cube_images(
    camera: CameraModel, scene: SpectralImage, effects: Sequence[Effect], oversample: int, margin_px: int
) -> dict[str, FloatArray]:
    """Electrons a second (rows, cols) of every channel, of a cube of spectra, before cos^4.

    As in `_blurred_images`, image = sum_k OTF_k F[sum_b w_bk band_b]: a cube of any number of bands becomes one picture a
    wavelength of the rule. A cube whose samples are the camera's pixels needs no finer grid: its transfer is folded.
    """
    moves = _light_moves(camera, effects)
    aligned = scene.to_camera is None and not moves
    grid = Grid(camera.rows, camera.cols, 1 if aligned else oversample, margin_px)
    # An aligned picture starts at pixel [0, 0]; what is left of the grid keeps its two ends apart.
    shape = tuple(fft.next_fast_len(n, real=True) for n in grid.shape) if aligned else grid.shape
    ny, nx = shape
    start = 0 if aligned else margin_px
    fy, fx, pixel_y, pixel_x = _pixel_on_grid(camera, grid)
    images: dict[str, FloatArray] = {}
    for channel in camera.channels:
        nodes, pictures = _node_pictures(camera, channel, scene, effects)
        spectrum = np.zeros((ny, nx // 2 + 1), np.complex64)
        moved = np.zeros((camera.rows, camera.cols))
        for node, picture in zip(nodes, pictures, strict=True):
            if aligned:
                transfer = _folded_transfer(camera, float(node), (ny, nx), _blurring(effects))
                fine = np.zeros((ny, nx), np.float32)
                seen = picture[: camera.rows + margin_px, : camera.cols + margin_px]
                fine[: seen.shape[0], : seen.shape[1]] = seen
            else:
                transfer = _transfer_at(camera, float(node), fx, fy, _blurring(effects))
                fine = cell_means(picture.astype(float), scene.warp(), grid, 0.0).astype(np.float32)
            transformed = fft.rfft2(fine)
            transformed *= transfer.astype(np.complex64 if np.iscomplexobj(transfer) else np.float32)
            if moves:
                moved += _at_moved_pixels(camera, transformed * (pixel_y * pixel_x), grid, float(node), effects)
            else:
                spectrum += transformed
        if not aligned:
            spectrum *= (pixel_y * pixel_x).astype(np.complex64)
        image = _at_pixels(spectrum, grid.oversample, nx)[start : start + grid.rows, start : start + grid.cols]
        images[channel] = np.maximum(moved if moves else image, 0.0).astype(float)
    return images


def _node_pictures(
    camera: CameraModel, channel: str, scene: SpectralImage, effects: Sequence[Effect]
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Wavelengths (nm) of the frame's rule, and the electrons a second that the cube's samples give at each: (nodes, rows, cols)."""
    lights: list[Light] = [(band, None) for band in scene.bands()]
    wavelength_nm, weight = _detected(camera, channel, lights, effects, scene.kind)
    weight = weight * _collection_m2_sr(camera)
    nodes, _ = _otf_wavelengths(camera, channel, wavelength_nm, np.sum(weight, axis=0), FRAME_WAVELENGTHS)
    shares = lagrange_shares(wavelength_nm, weight, nodes)
    field = _field_of_rates(camera, channel, lights, effects, scene.kind)
    rows, cols, bands = scene.radiance.shape
    out = np.empty((nodes.size, rows, cols), np.float32)
    strip = max(1, 4_000_000 // (cols * bands))
    for top in range(0, rows, strip):
        part = scene.radiance[top : top + strip].reshape(-1, bands)
        if field is not None:
            v, u = np.meshgrid(np.arange(top, min(top + strip, rows)) + 0.5, np.arange(cols) + 0.5, indexing="ij")
            square = np.minimum(sin_theta_at(camera, *scene.warp().to_camera(u, v)) ** 2, field[0].x[-1]).ravel()
            part = part * np.stack([spline(square) for spline in field], axis=1)
        out[:, top : top + strip] = (shares.T.astype(part.dtype) @ part.T).reshape(nodes.size, -1, cols)
    return nodes, out


def _folded_transfer(
    camera: CameraModel, wavelength_nm: float, shape: tuple[int, int], effects: Sequence[Effect]
) -> FloatArray | ComplexArray:
    """`_transfer_at` with the pixel's aperture and a picture's square of one pixel, folded onto samples of one pixel."""
    from sim.optics.fold import folded, folded_diffraction  # here: the compiler's library takes a while to load

    imaging = camera.lens.imaging
    cutoff = camera.pixel_pitch_um * imaging.cutoff_cy_per_um(wavelength_nm, camera.lens.f_number)
    if isinstance(imaging, DiffractionLimited) and all(type(effect).transfer is Effect.transfer for effect in effects):
        return folded_diffraction(shape, camera.fill_factor, cutoff)
    return folded(
        lambda fx, fy: _transfer_at(camera, wavelength_nm, fx, fy, effects),
        shape,
        camera.fill_factor,
        min(cutoff, HIGHEST_CY_PER_PX / 8.0),
    )


def _pixel_on_grid(camera: CameraModel, grid: Grid) -> tuple[FloatArray, FloatArray, ComplexArray, ComplexArray]:
    """Frequencies fy (n, 1) and fx (1, n), cy/px, of a drawing's transform, and the factors on each that make samples pixels.

    The pixel's aperture; a sample is a mean over its square, which is undone; a pixel's centre lies between even samples.
    """
    s = grid.oversample
    ny, nx = grid.shape
    fy, fx = fft.fftfreq(ny, 1.0 / s)[:, None], fft.rfftfreq(nx, 1.0 / s)[None, :]
    shift = 1j * np.pi * (1.0 - 1.0 / s)
    pixel_x, pixel_y = (aperture_otf(f, 0.0, camera.fill_factor) * np.exp(shift * f) / np.sinc(f / s) for f in (fx, fy))
    return fy, fx, pixel_y, pixel_x


def _at_pixels(spectrum: ComplexArray | NDArray[np.complex64], oversample: int, cols: int) -> FloatArray:
    """Back from a transform to every `oversample`-th row and column: the rows are folded first."""
    folded_rows = spectrum.reshape(oversample, len(spectrum) // oversample, -1).sum(axis=0) / oversample
    return np.asarray(fft.irfft(fft.ifft(folded_rows, axis=0), cols, axis=1)[:, ::oversample])


def _light_moves(camera: CameraModel, effects: Sequence[Effect]) -> bool:
    """Whether any effect lets light land elsewhere."""
    axis = np.zeros(1)
    return any(effect.image_shift_um(axis, axis, 550.0, camera) is not None for effect in effects)


def _shift_px(
    camera: CameraModel, row: FloatArray, col: FloatArray, wavelength_nm: float, effects: Sequence[Effect]
) -> tuple[FloatArray, FloatArray]:
    """How far (rows, columns) the light of one wavelength lands from where the baseline has it, at points in px."""
    pitch = camera.pixel_pitch_um
    x_um, y_um = (col - 0.5 * (camera.cols - 1)) * pitch, (row - 0.5 * (camera.rows - 1)) * pitch
    down, right = (
        np.zeros(np.broadcast_shapes(row.shape, col.shape)),
        np.zeros(np.broadcast_shapes(row.shape, col.shape)),
    )
    for effect in effects:
        shift = effect.image_shift_um(x_um, y_um, wavelength_nm, camera)
        if shift is not None:
            right, down = right + shift[0] / pitch, down + shift[1] / pitch
    return down, right


class _ShiftAt(Effect):
    """The shifts of other effects at one place (px), less those of one wavelength, as the phase of a transfer function."""

    acting: tuple[Effect, ...]
    row: float
    col: float
    less_at_nm: float

    def transfer(
        self, fx_cy_per_um: FloatArray, fy_cy_per_um: FloatArray, wavelength_nm: float, camera: CameraModel
    ) -> ComplexArray:
        place = np.array(self.row), np.array(self.col)
        down, right = _shift_px(camera, *place, wavelength_nm, self.acting)
        mean_down, mean_right = _shift_px(camera, *place, self.less_at_nm, self.acting)
        turns = (fx_cy_per_um * (right - mean_right) + fy_cy_per_um * (down - mean_down)) * camera.pixel_pitch_um
        return np.asarray(np.exp(-2j * np.pi * turns))


def _mean_wavelength(
    camera: CameraModel, channel: str, radiance: Spectrum | None, effects: Sequence[Effect], kind: str
) -> float:
    """Mean wavelength (nm) of the light that a channel detects."""
    wavelength_nm, weight = _detected(camera, channel, [(radiance, None)], effects, kind)
    nodes, share = _otf_wavelengths(camera, channel, wavelength_nm, weight[0], 1)
    return float(nodes @ share)


def _unmoved_px(
    camera: CameraModel, row: FloatArray, col: FloatArray, wavelength_nm: float, effects: Sequence[Effect]
) -> tuple[FloatArray, FloatArray]:
    """The places p with p + shift(p) = (row, col), by fixed-point steps to 1e-4 px: shifts change by less than they are."""
    from_row, from_col = row, col
    for _ in range(40):
        down, right = _shift_px(camera, from_row, from_col, wavelength_nm, effects)
        step = max(np.max(np.abs(row - down - from_row)), np.max(np.abs(col - right - from_col)))
        from_row, from_col = row - down, col - right
        if step < 1e-4:
            return from_row, from_col
        if step > camera.rows + camera.cols:
            break
    raise ValueError(
        f"light is moved by {max(np.max(np.abs(down)), np.max(np.abs(right))):.3g} px, and by steps of {step:.3g} px back no place is found that it comes from: the distortion folds the image; give less of it"
    )


def _margin_for(camera: CameraModel, effects: Sequence[Effect], margin_px: int) -> int:
    """The margin that a frame needs for light that is moved in from outside it."""
    if not _light_moves(camera, effects):
        return margin_px
    row, col = (np.linspace(0.0, n - 1.0, 33) for n in (camera.rows, camera.cols))
    rim_row = np.concatenate([row, row, np.zeros(33), np.full(33, camera.rows - 1.0)])
    rim_col = np.concatenate([np.zeros(33), np.full(33, camera.cols - 1.0), col, col])
    out = 0.0
    for wavelength_nm in (400.0, 550.0, 700.0):
        from_row, from_col = _unmoved_px(camera, rim_row, rim_col, wavelength_nm, effects)
        out = max(out, *(float(np.max(np.abs(a - b))) for a, b in ((from_row, rim_row), (from_col, rim_col))))
    return margin_px + int(np.ceil(out))


def _at_moved_pixels(
    camera: CameraModel, spectrum: ComplexArray, grid: Grid, wavelength_nm: float, effects: Sequence[Effect]
) -> FloatArray:
    """Back from a transform to the frame's pixels, each taken where its light would be without the effects' shifts; between
    the image's samples by splines of the third order, on the drawing's grid: 1e-3 of the contrast at 1/2 cy/px and 3 samples a pixel."""
    row, col = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    from_row, from_col = _unmoved_px(camera, row, col, wavelength_nm, effects)
    image = fft.irfft2(spectrum, grid.shape)
    place = np.stack([from_row + grid.margin_px, from_col + grid.margin_px]) * grid.oversample
    return np.asarray(map_coordinates(image, place, mode="grid-wrap"))


def _relative_to_ground(
    camera: CameraModel, grid: Grid, window: tuple[slice, slice], field: CubicSpline, ground: CubicSpline
) -> FloatArray:
    """How a light's rate changes over the field, over how the ground's does, on a window of the grid."""
    row, col = grid.axes_px()
    square = np.minimum(sin_theta_at(camera, row[window[0], None], col[None, window[1]]) ** 2, field.x[-1])
    return np.asarray(field(square) / np.maximum(ground(square), 1e-12))


def _transform(
    grid: Grid, windows: Sequence[tuple[slice, slice]], pictures: Sequence[FloatArray], factors: Sequence[float]
) -> ComplexArray:
    """Fourier transform of the sum of factor x picture, each on its window of the grid."""
    total = np.zeros(grid.shape)
    for window, picture, factor in zip(windows, pictures, factors, strict=True):
        total[window] += factor * picture
    return np.asarray(fft.rfft2(total), complex)


# --- the steps of an exposure one by one, for who keeps a scene's light over many exposures -----------------------------


@dataclass(frozen=True, eq=False)
class SceneLight:
    """Electrons a second that light makes in every pixel, (rows, cols): of the scene, and of the room beside it."""

    scene: FloatArray
    room: FloatArray | float = 0.0


class KeptTransfers:
    """The transfers that whole frames were blurred with, for the next scene in the same lights; of one camera with one set of
    effects. The latest `most` are kept, one a channel and light, of 12 MB at 480 x 640 px and 3 samples a pixel."""

    def __init__(self, most: int = 3) -> None:
        self._kept: OrderedDict[Hashable, list[NDArray[np.complex64]]] = OrderedDict()
        self._most = most

    def get(self, key: Hashable, make: Callable[[], list[ComplexArray]]) -> list[NDArray[np.complex64]]:
        """What is kept for `key`, else what `make` makes."""
        if key not in self._kept:
            self._kept[key] = [part.astype(np.complex64) for part in make()]
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


def scene_light(
    camera: CameraModel,
    scene: Scene,
    effects: Sequence[Effect] = (),
    *,
    oversample: int = 3,
    margin_px: int = 32,
    placed: Literal["ideal", "image"] = "ideal",
    transfers: KeptTransfers | None = None,
) -> SceneLight:
    """The part of `expected_electrons` that no exposure changes, and that takes nearly all its time."""
    shape = camera.rows, camera.cols
    if isinstance(scene, Darkness):
        return SceneLight(np.zeros(shape))
    row, col = np.arange(camera.rows, dtype=np.float64)[:, None], np.arange(camera.cols, dtype=np.float64)[None, :]
    if isinstance(camera.lens.imaging, TracedLens):
        traced = _traced_image(camera, camera.lens.imaging.table, scene, effects, oversample, margin_px, placed)
        images = dict.fromkeys(camera.channels, traced)
        shade: FloatArray = np.ones(shape)
    else:
        images = _plain_images(camera, scene, effects, oversample, margin_px, transfers)
        shade = relative_illumination(camera, row, col)
    x_um: FloatArray = (col - 0.5 * (camera.cols - 1)) * camera.pixel_pitch_um
    y_um: FloatArray = (row - 0.5 * (camera.rows - 1)) * camera.pixel_pitch_um
    for effect in effects:
        shade = shade * np.maximum(effect.illumination(x_um, y_um, camera), 0.0)
    images = {channel: _reflected(image, camera, effects) * shade for channel, image in images.items()}
    ambient = {c: sum(effect.ambient_e_per_s(c, camera) for effect in effects) for c in camera.channels}
    if not any(ambient.values()):
        return SceneLight(mosaic.assemble(images, camera.cfa))
    room = {channel: np.full(shape, float(value)) for channel, value in ambient.items()}
    return SceneLight(mosaic.assemble(images, camera.cfa), mosaic.assemble(room, camera.cfa))


def collected_electrons(
    light: SceneLight, camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, source: float = 1.0
) -> FloatArray:
    """`expected_electrons` of a scene whose light is known. `source`: factor on the scene's light at this time, beside the effects'."""
    collected_s = exposure.exposure_s
    for effect in effects:
        collected_s = effect.exposure(collected_s)
        source *= max(effect.drift(exposure.elapsed_s), 0.0)
    if exposure.magnification != 0.0:
        source *= irradiance_factor(camera.lens.f_number, exposure.magnification) / irradiance_factor(
            camera.lens.f_number
        )
    lit = (light.scene * source + light.room) * collected_s
    for effect in effects:
        lit = effect.lit(lit, exposure.exposure_s, exposure.elapsed_s, camera)
    electrons = lit + dark_electrons(camera, exposure, effects)
    for effect in effects:
        electrons = effect.charge(electrons, exposure.exposure_s, camera)
    for effect in effects:
        electrons = effect.overflow(electrons, camera)
    return electrons


def read_electrons(
    collected: FloatArray, camera: CameraModel, effects: Sequence[Effect] = ()
) -> tuple[FloatArray, FloatArray | float]:
    """Of the mean electrons that a frame holds, those that are read, and those that stay in the pixels for the next frame."""
    left: FloatArray | float = 0.0
    for effect in effects:
        left = left + effect.left_behind(np.minimum(collected, camera.full_well_e), camera)
    return collected - left, left


def radiance_at_lens(radiance: Spectrum, effects: Sequence[Effect], kind: str) -> Spectrum:
    """The radiance in front of the lens where the radiometer says `radiance`, in a capture of `kind`."""
    wavelength_nm, value = radiance.arrays
    for effect in effects:
        value = effect.radiance(wavelength_nm, value, kind)
    return Spectrum.of(wavelength_nm, value)


def scene_gain(effects: Sequence[Effect]) -> float:
    """Factor on the right camera's light over the left one's in a scene that both see, against uniform light."""
    return float(np.prod([effect.scene_gain() for effect in effects]))
