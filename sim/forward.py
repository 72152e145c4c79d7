"""The one forward model: how light becomes a raw frame. Only composition; every stage stands in its own module.

    radiance -> (effects on the rig) -> lens: irradiance factor, transmittance, cos^4 -> optical transfer (diffraction, pixel
    aperture, effects) -> quantum efficiency by mosaic -> electrons + dark current -> (effects on charge) -> shot noise, full
    well -> (effects on the read-out) -> read noise, gain, black level -> codes

An effect acts through the hooks of `sim.effects.base.Effect`; without effects, or with effects at their absent values, the
result is the baseline bit for bit. Frequencies are cy/px, fx along columns (to the right), fy along rows (down).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.interpolate import CubicSpline

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.optics.diffraction import aperture_otf, diffraction_cutoff_cy_per_um, diffraction_otf
from sim.optics.illumination import irradiance_factor, relative_illumination
from sim.optics.illumination import sin_theta as sin_theta_at
from sim.scene.render import Grid, layers
from sim.scene.scenes import Darkness, KnifeEdge, Scene, UniformField
from sim.sensor import electrons as sensor
from sim.sensor import mosaic
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, Spectrum, photons_from_energy, quadrature

ComplexArray = NDArray[np.complex128]

#: Wavelengths at which an optical transfer function is averaged over light and sensitivity (Gauss's rule for that weight).
OTF_WAVELENGTHS = 10


@dataclass(frozen=True)
class Exposure:
    """One exposure of a scene. `gain_db` is the analogue gain; `temperature_c` is for the record (the camera's dark current
    holds at the temperature it is stated for)."""

    scene: Scene
    exposure_s: float
    gain_db: float = 0.0
    temperature_c: float | None = None

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
    _, weight = _spectral_weight(camera, channel, radiance, effects, kind, sin_theta, reflectance)
    area_m2 = (camera.pixel_pitch_um * 1e-6) ** 2 * camera.fill_factor
    return float(np.sum(weight)) * irradiance_factor(camera.lens.f_number, magnification) * area_m2


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

    The average of diffraction x the effects' transfer, weighted by the detected electrons (light x responsivity) over
    wavelength, times the pixel's aperture. `radiance` None: light of equal energy at every wavelength.
    """
    fx, fy = np.broadcast_arrays(np.asarray(fx_cy_per_px, float), np.asarray(fy_cy_per_px, float))
    nodes, share = _otf_wavelengths(camera, channel, radiance, effects, kind, reflectance)
    total = np.zeros(fx.shape, complex)
    for wavelength_nm, part in zip(nodes, share, strict=True):
        total += part * _transfer_at(camera, float(wavelength_nm), fx, fy, effects)
    return total * aperture_otf(fx, fy, camera.fill_factor)


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
    reach = max(64.0, 1.05 * float(np.max(np.abs(distance_px), initial=0.0)))
    nodes, _ = _otf_wavelengths(camera, channel, radiance, effects, kind, None)
    cutoff = camera.pixel_pitch_um * diffraction_cutoff_cy_per_um(float(np.min(nodes)), camera.lens.f_number)
    highest = min(cutoff, 64.0)
    period = 16.0 * reach
    count = int(np.ceil(highest * period)) + 1
    f = np.arange(count) / period
    angle = np.deg2rad(angle_deg)
    transfer = optical_transfer(camera, channel, radiance, f * np.cos(angle), f * np.sin(angle), effects, kind)
    samples = fft.next_fast_len(int(period * max(32.0, 4.0 * highest)), real=True)
    series = np.zeros(samples // 2 + 1, complex)
    # Integral of the line spread function, term by term; the constant term gives the ramp d / period.
    series[1:count] = transfer[1:] / (2j * np.pi * np.arange(1, count))
    profile = fft.irfft(series, samples) * samples
    step = period / samples
    wing = int(np.ceil(reach / step)) + 4
    at = np.arange(-wing, wing + 1)
    table = CubicSpline(at * step, profile[at] + at * step / period + 0.5)
    return table(distance_px)


def kernel(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    support: int,
    oversample: int = 1,
    effects: Sequence[Effect] = (),
    kind: str = "bernoulli",
) -> FloatArray:
    """Point spread function with the pixel's aperture, (support, support) samples of 1/oversample px, sum 1.

    Each sample is the mean response to light spread evenly over the sample's square, so that the kernel convolves a picture
    drawn by area. The centre is the middle sample; `support` is odd.
    """
    if support < 1 or support % 2 == 0:
        raise ValueError(f"support {support} of the kernel has to be odd and at least 1: take {support + 1}")
    size = fft.next_fast_len(4 * support + 16 * oversample)
    f = fft.fftfreq(size, 1.0 / oversample)
    fx, fy = f[None, :], f[:, None]
    transfer = optical_transfer(camera, channel, radiance, fx, fy, effects, kind)
    transfer = transfer * np.sinc(fx / oversample) * np.sinc(fy / oversample)
    spread = np.real(fft.ifft2(transfer))
    half = support // 2
    psf = np.roll(spread, (half, half), axis=(0, 1))[:support, :support]
    return psf / np.sum(psf)


def expected_electrons(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 2, margin_px: int = 32
) -> FloatArray:
    """Mean electrons (rows, cols) of every pixel, light and dark current, after the effects on charge; not yet clipped.

    Scenes that aren't uniform or straight edges are drawn by area on `oversample` x `oversample` samples a pixel, with
    `margin_px` around the frame, and blurred channel by channel with the channel's transfer function.
    """
    light = _light_electron_rate(camera, exposure.scene, effects, oversample, margin_px) * exposure.exposure_s
    electrons = light + dark_electrons(camera, exposure)
    for effect in effects:
        electrons = effect.charge(electrons, exposure.exposure_s, camera)
    return electrons


def dark_electrons(camera: CameraModel, exposure: Exposure) -> float:
    """Mean electrons of the dark current in one exposure."""
    return camera.dark_current_e_per_s * exposure.exposure_s


def expected(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 2, margin_px: int = 32
) -> FloatArray:
    """Mean frame (rows, cols) in DN, not rounded, of a camera whose pixels are all alike; clipping is averaged over noise."""
    electrons = expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px)
    return sensor.dn_moments(electrons, camera, exposure.gain_db, read_out(camera, effects))[0]


def variance(
    camera: CameraModel, exposure: Exposure, effects: Sequence[Effect] = (), *, oversample: int = 2, margin_px: int = 32
) -> FloatArray:
    """Temporal variance (rows, cols) in DN^2: shot and read noise, clipping, and 1/12 for rounding."""
    electrons = expected_electrons(camera, exposure, effects, oversample=oversample, margin_px=margin_px)
    return sensor.dn_moments(electrons, camera, exposure.gain_db, read_out(camera, effects))[1]


def sample(
    camera: CameraModel,
    exposure: Exposure,
    rng: np.random.Generator,
    effects: Sequence[Effect] = (),
    fixed_pattern: FixedPattern | None = None,
    *,
    oversample: int = 2,
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
        dark_electrons=dark_electrons(camera, exposure),
        gain_db=exposure.gain_db,
        response=read_out(camera, effects),
    )


def read_out(camera: CameraModel, effects: Sequence[Effect]) -> sensor.Response | None:
    """The effects' responses one after the other, or None without effects."""
    if not effects:
        return None

    def response(electrons: FloatArray) -> FloatArray:
        for effect in effects:
            electrons = effect.response(electrons, camera)
        return electrons

    return response


# --- parts -----------------------------------------------------------------------------------------------------------


def _efficiency(camera: CameraModel, channel: str) -> Spectrum:
    if channel not in camera.channels or channel not in camera.quantum_efficiency:
        raise ValueError(
            f"channel {channel!r} has no quantum efficiency in this {camera.cfa} camera (known: {', '.join(camera.quantum_efficiency)}): add the curve or ask for another channel"
        )
    return camera.quantum_efficiency[channel]


def _spectral_weight(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    effects: Sequence[Effect],
    kind: str,
    sin_theta: float,
    reflectance: Spectrum | None,
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths (nm) and detected electrons at each: photons s^-1 m^-2 sr^-1 x responsivity x quadrature weight."""
    curves = [_efficiency(camera, channel)]
    curves += [curve for curve in (radiance, reflectance) if curve is not None]
    wavelength_nm, width = quadrature(curves)
    light = np.ones_like(wavelength_nm) if radiance is None else radiance.at(wavelength_nm)
    for effect in effects:
        light = effect.radiance(wavelength_nm, light, kind)
    _check_radiance(wavelength_nm, light)
    if reflectance is not None:
        light = light * reflectance.at(wavelength_nm)
    photons = photons_from_energy(wavelength_nm, light)
    return wavelength_nm, photons * responsivity(camera, channel, wavelength_nm, effects, sin_theta) * width


def _check_radiance(wavelength_nm: FloatArray, radiance: FloatArray) -> None:
    lowest = int(np.argmin(np.where(np.isfinite(radiance), radiance, -np.inf)))
    if not radiance[lowest] >= 0:
        raise ValueError(
            f"radiance is {radiance[lowest]:g} W sr^-1 m^-2 nm^-1 at {wavelength_nm[lowest]:g} nm, below the limit of 0 or not finite: subtract the radiometer's dark reading, and set what stays below 0 to 0"
        )


def _otf_wavelengths(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum | None,
    effects: Sequence[Effect],
    kind: str,
    reflectance: Spectrum | None,
) -> tuple[FloatArray, FloatArray]:
    """A few wavelengths (nm) and shares (sum 1) over which to average the transfer function."""
    wavelength_nm, weight = _spectral_weight(camera, channel, radiance, effects, kind, 0.0, reflectance)
    total = float(np.sum(weight))
    if not total > 0:
        # No light: nothing is weighted, any OTF will do; the middle of the sensitivity is the natural one.
        wavelength_nm, weight = _spectral_weight(camera, channel, None, (), kind, 0.0, None)
        total = float(np.sum(weight))
    if not total > 0:
        raise ValueError(f"channel {channel!r} has a quantum efficiency of 0 everywhere: give its curve")
    return gauss_rule(wavelength_nm, weight / total, OTF_WAVELENGTHS)


def gauss_rule(position: FloatArray, weight: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Gauss's quadrature for a discrete weight: at most `count` nodes and shares with the same moments up to 2 count - 1.

    Lanczos's tridiagonal matrix of the positions in the weight's inner product; nodes are its eigenvalues, shares the squares
    of the eigenvectors' first entries (Golub and Welsch 1969). Weights are >= 0 and add up to 1.
    """
    used = weight > 0
    x, w = position[used], weight[used]
    centre, half = 0.5 * (x[0] + x[-1]), max(0.5 * (x[-1] - x[0]), 1e-9)
    t = (x - centre) / half
    basis = np.sqrt(w)[None, :]
    diagonal, off = [], []
    for _ in range(min(count, x.size)):
        v = basis[-1]
        diagonal.append(float(v @ (t * v)))
        residual = t * v
        residual -= (basis @ residual) @ basis
        residual -= (basis @ residual) @ basis  # twice is enough to stay orthogonal
        norm = float(np.linalg.norm(residual))
        if norm < 1e-9:
            break
        off.append(norm)
        basis = np.vstack([basis, residual / norm])
    matrix = np.diag(diagonal) + np.diag(off[: len(diagonal) - 1], 1) + np.diag(off[: len(diagonal) - 1], -1)
    values, vectors = np.linalg.eigh(matrix)
    return centre + half * values, vectors[0] ** 2


def _transfer_at(
    camera: CameraModel, wavelength_nm: float, fx: FloatArray, fy: FloatArray, effects: Sequence[Effect]
) -> FloatArray | ComplexArray:
    """Diffraction x the effects' transfer at one wavelength; fx, fy in cy/px."""
    fx_um, fy_um = fx / camera.pixel_pitch_um, fy / camera.pixel_pitch_um
    value: FloatArray | ComplexArray = diffraction_otf(np.hypot(fx_um, fy_um), wavelength_nm, camera.lens.f_number)
    for effect in effects:
        factor = effect.transfer(fx_um, fy_um, wavelength_nm, camera)
        if factor is not None:
            value = value * factor
    return value


def _light_electron_rate(
    camera: CameraModel, scene: Scene, effects: Sequence[Effect], oversample: int, margin_px: int
) -> FloatArray:
    """Electrons a second of every pixel that light makes, (rows, cols)."""
    shape = camera.rows, camera.cols
    if isinstance(scene, Darkness):
        return np.zeros(shape)
    row, col = np.arange(camera.rows)[:, None], np.arange(camera.cols)[None, :]
    images: dict[str, FloatArray] = {}
    for channel in camera.channels:
        if isinstance(scene, UniformField):
            images[channel] = np.full(shape, electron_rate(camera, channel, scene.radiance, effects, scene.kind))
        elif isinstance(scene, KnifeEdge):
            images[channel] = _edge_image(camera, channel, scene, effects)
        else:
            images[channel] = _blurred_image(camera, channel, scene, effects, Grid(*shape, oversample, margin_px))
        images[channel] = images[channel] * _field(camera, channel, scene, effects)
    return mosaic.assemble(images, camera.cfa) * relative_illumination(camera, row, col)


def _field(camera: CameraModel, channel: str, scene: Scene, effects: Sequence[Effect]) -> FloatArray:
    return np.ones((camera.rows, camera.cols))


def _edge_image(camera: CameraModel, channel: str, scene: KnifeEdge, effects: Sequence[Effect]) -> FloatArray:
    row, col = np.meshgrid(np.arange(camera.rows, dtype=float), np.arange(camera.cols, dtype=float), indexing="ij")
    away = []
    for edge in scene.regions:
        row0, col0, row1, col1 = edge.region
        down = np.maximum(np.maximum(row0 - row, row - (row1 - 1)), 0.0)
        across = np.maximum(np.maximum(col0 - col, col - (col1 - 1)), 0.0)
        away.append(np.hypot(down, across))
    owner = np.argmin(np.stack(away), axis=0)
    dark = electron_rate(camera, channel, scene.dark_radiance, effects, scene.kind)
    light = electron_rate(camera, channel, scene.light_radiance, effects, scene.kind)
    image = np.empty(row.shape)
    for index, edge in enumerate(scene.regions):
        mine = owner == index
        distance = edge.distance_px(row[mine], col[mine])
        bright = edge_profile(camera, channel, scene.light_radiance, edge.angle_deg, distance, effects, scene.kind)
        dim = edge_profile(camera, channel, scene.dark_radiance, edge.angle_deg, distance, effects, scene.kind)
        image[mine] = light * bright + dark * (1.0 - dim)
    return image


def _blurred_image(
    camera: CameraModel, channel: str, scene: Scene, effects: Sequence[Effect], grid: Grid
) -> FloatArray:
    s, m = grid.oversample, grid.margin_px
    fy = fft.fftfreq(grid.shape[0], 1.0 / s)[:, None]
    fx = fft.rfftfreq(grid.shape[1], 1.0 / s)[None, :]
    # A sample is a mean over its square, which the transfer function undoes; and pixel centres lie between even samples.
    to_pixel = np.exp(2j * np.pi * 0.5 * (1.0 - 1.0 / s) * (fx + fy)) / (np.sinc(fx / s) * np.sinc(fy / s))
    spectrum = np.zeros((grid.shape[0], grid.shape[1] // 2 + 1), complex)
    for layer in layers(scene, grid):
        picture = np.zeros(grid.shape)
        picture[layer.window] = layer.coverage
        rate = electron_rate(camera, channel, layer.radiance, effects, scene.kind, reflectance=layer.reflectance)
        transfer = optical_transfer(
            camera, channel, layer.radiance, fx, fy, effects, scene.kind, reflectance=layer.reflectance
        )
        spectrum += fft.rfft2(picture) * transfer * rate
    image = fft.irfft2(spectrum * to_pixel, grid.shape)[::s, ::s]
    return np.maximum(image[m : m + grid.rows, m : m + grid.cols], 0.0)
