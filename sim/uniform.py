"""The entry for uniform light: one pixel of each channel. Rates, levels, darks, patches, and the noise of all of
these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial, reduce
from typing import Literal

import numpy as np
from scipy.special import ndtri

from sim.camera import CameraModel, Cfa
from sim.detection import collection_m2_sr, detect_light
from sim.optics.illumination import optical_axis_px, relative_illumination
from sim.sensor import mosaic
from sim.sensor.amplifiers import CoupledAmplifiers
from sim.sensor.defects import Defects, Jumps
from sim.sensor.lines import LineGains, LineNoise, Lines
from sim.sensor.margins import Margins
from sim.sensor.particles import Particles
from sim.sensor.reading_order import ReadOutNoise
from sim.spectrum import FloatArray, Spectrum
from sim.stages import Acts, Charge, Codes, Image, Light, Signal, charge_of, codes_of, image_of, light_of, signal_of

#: Quantities of the stages that rates by wavelength depend on.
SPECTRAL = frozenset({"light.spectrum", "image.transmittance", "image.ripple"})
#: Those that shade the light by place.
SHADING = frozenset({"light.shading", "image.shading"})
#: Light that falls on other pixels than its own.
STRAYS = frozenset({"charge.strays"})
#: Those that levels of uniform light depend on, at given rates.
LEVEL = (
    SHADING
    | STRAYS
    | {
        "light.level",
        "light.level_by_channel",
        "charge.exposure_s",
        "charge.leak_s",
        "light.ambient_e_per_s",
        "charge.kernels",
        "charge.exchange",
        "charge.trails",
        "signal.response",
        "signal.offset_dn",
        "signal.exposure_offset_dn",
        "codes.codes",
    }
)

#: Values that stand for the noise of a level: over all its points, and the most and the least at one point.
NOISE_VALUES, MOST_AT_A_POINT, LEAST_AT_A_POINT = 480, 48, 6
#: Share of the brightest channel to which `Uniform.light_of` is exact, and the most steps that it takes.
LEAST_UNMIXED, MOST_UNMIXED = 1e-7, 40
GOLDEN_RATIO = 0.5 * (np.sqrt(5.0) - 1.0)


@cache
def noise_values(points: int) -> FloatArray:
    """Choose values of equal weight that stand for a normal variable of mean 0 and standard deviation 1 at each
    point.

    points : number of points

    Returns (points, values): at each point the quantiles (i + s) / k, i = 0..k - 1. The offset s differs from point
    to point by the golden ratio, so that points of similar levels sample the distribution k x points times.

    >>> values = noise_values(4)
    >>> abs(round(float(values.mean()), 9)), round(float(values.std()), 9)
    (0.0, 1.0)
    """
    count = int(np.clip(NOISE_VALUES // points, LEAST_AT_A_POINT, MOST_AT_A_POINT))
    offset = (0.5 + GOLDEN_RATIO * np.arange(points)) % 1.0
    values = ndtri((np.arange(count) + offset[:, None]) / count)
    return np.asarray((values - values.mean()) / values.std())


@dataclass(frozen=True)
class FieldPoints:
    """Points on the sensor that stand for a part of the frame or all of it: (points,) um from the optical axis, and the
    light there, 1 on axis.
    """

    x_um: FloatArray
    y_um: FloatArray
    light: FloatArray

    @staticmethod
    def of(camera: CameraModel, rows: int = 8, cols: int = 10) -> FieldPoints:
        """Return the whole frame: Gauss's points and equal areas would differ by less than 1e-5 of a cos^4 field's mean
        on 8 x 10 cells' centres.
        """
        row = (np.arange(rows) + 0.5) / rows * camera.rows - 0.5
        col = (np.arange(cols) + 0.5) / cols * camera.cols - 0.5
        grid_row, grid_col = (g.ravel() for g in np.meshgrid(row, col, indexing="ij"))
        return FieldPoints.at(camera, grid_row, grid_col)

    @staticmethod
    def at(camera: CameraModel, row: FloatArray, col: FloatArray) -> FieldPoints:
        """Points at given rows and columns (px)."""
        row0, col0 = optical_axis_px(camera)
        pitch = camera.pixel_pitch_um
        return FieldPoints((col - col0) * pitch, (row - row0) * pitch, relative_illumination(camera, row, col))


def electron_rate(
    camera: CameraModel,
    channel: str,
    radiance: Spectrum,
    effects: Sequence[Acts] = (),
    kind: str = "flat",
    sin_theta: float = 0.0,
    *,
    reflectance: Spectrum | None = None,
    magnification: float = 0.0,
) -> float:
    """Electrons a second of one pixel of `channel` on axis, in a uniform field of `radiance` (W sr^-1 m^-2 nm^-1).

    pi / (1 + 4 N^2 (1 + |m|)^2) x pitch^2 x fill_factor x integral of radiance x wavelength / (h c) x responsivity.
    `kind` is the capture's, for effects on the rig. Off axis, `sin_theta` only enters the effects' transmittance:
    multiply by `sim.optics.illumination.relative_illumination` for the fall-off. `reflectance` stands for a chart's
    patch under a light whose radiance on a perfect diffuser is `radiance`. Raises ValueError for radiance below 0.
    """
    _, weight = detect_light(camera, channel, [(radiance, reflectance)], effects, kind, sin_theta)
    return float(np.sum(weight)) * collection_m2_sr(camera, magnification)


def radiance_at_lens(camera: CameraModel, radiance: Spectrum, effects: Sequence[Acts], kind: str) -> Spectrum:
    """Return the radiance in front of the lens where the radiometer says `radiance`, in a capture of `kind`."""
    wavelength_nm, value = radiance.arrays
    return Spectrum.of(wavelength_nm, light_of(camera, effects).radiance(wavelength_nm, value, kind))


class Uniform:
    """Response of a camera with effects to uniform light. Electrons and DN are means of many pixels unless a method
    says otherwise.
    """

    def __init__(self, camera: CameraModel, effects: Sequence[Acts] = ()) -> None:
        self.camera, self._effects = camera, tuple(effects)

    @cached_property
    def _light(self) -> Light:
        return light_of(self.camera, self._effects)

    @cached_property
    def _image(self) -> Image:
        return image_of(self.camera, self._effects)

    @cached_property
    def _charge(self) -> Charge:
        return charge_of(self.camera, self._effects)

    @cached_property
    def _signal(self) -> Signal:
        return signal_of(self.camera, self._effects)

    @cached_property
    def _codes(self) -> Codes:
        return codes_of(self.camera, self._effects)

    # --- light -------------------------------------------------------------------------------------------------------

    def radiance(self, wavelength_nm: FloatArray, radiance: FloatArray, kind: str) -> FloatArray:
        """Return the radiance in front of the lens, given what the radiometer said; `kind` is the capture's."""
        return self._light.radiance(wavelength_nm, radiance, kind)

    def transmittance(self, wavelength_nm: FloatArray) -> FloatArray:
        """Return the transmittance of what effects put into the light's way, on axis, at `wavelength_nm`."""
        return self._image.transmit(wavelength_nm, 0.0)

    def field(self, points: FieldPoints) -> FieldPoints:
        """Return the same points in the light that the effects leave there."""
        return replace(points, light=self.shade_light(points.light, points.x_um, points.y_um))

    def shade_light(self, light: FloatArray, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """Light at places (um from the sensor's centre) with the effects' shading."""
        for law in (*self._light.shading, *self._image.shading):
            light = light * np.maximum(law(x_um, y_um), 0.0)
        return light

    @property
    def has_patterns(self) -> bool:
        """Return whether the sensitivity differs by place and wavelength."""
        return bool(self._image.patterns)

    def pattern(self, channel: str, radiance: Spectrum, kind: str, x_um: FloatArray, y_um: FloatArray) -> FloatArray:
        """Factor on a channel's light of `radiance` at places that stand for the whole frame (um from the sensor's
        centre), of mean 1."""
        wavelength_nm, weight = detect_light(self.camera, channel, [(radiance, None)], self._effects, kind)
        return self._image.pattern(wavelength_nm, weight[0], x_um, y_um)

    def source(self, elapsed_s: float) -> float:
        """Factor on the source's radiance at a time after the first capture."""
        return self._light.source(elapsed_s)

    @property
    def unsteadiness(self) -> float:
        """Relative standard deviation of the source's light from frame to frame."""
        return float(np.sqrt(sum(law.relative_std**2 for law in self._light.unsteadiness)))

    @property
    def varies_by_row(self) -> bool:
        """Return whether the source's light varies while a frame is taken."""
        return bool(self._light.rows)

    def collected_s(self, exposure_s: float) -> float:
        """Return the time in which light is collected, given the time that was asked for."""
        return self._charge.collected_s(exposure_s)

    @property
    def leaks(self) -> bool:
        """Return whether light is collected beside the exposure."""
        return bool(self._charge.leak_s)

    def leaked_s(self, points: FieldPoints) -> FloatArray:
        """Return the time (points,) in which light is collected beside the exposure."""
        row0, col0 = optical_axis_px(self.camera)
        row, col = points.y_um / self.camera.pixel_pitch_um + row0, points.x_um / self.camera.pixel_pitch_um + col0
        leaked = self._charge.leaked_s(row / (self.camera.rows - 1.0), col / (self.camera.cols - 1.0))
        return np.asarray(leaked * np.ones(row.shape))

    def ambient_e(self, channel: str, exposure_s: float) -> float:
        """Electrons that light beside the source makes while the shutter is open, which is the time that light is
        collected.
        """
        return self._light.ambient(channel) * self._charge.collected_s(exposure_s)

    def row_factors(self, rows: int, exposure_s: float, elapsed_s: float) -> FloatArray:
        """Factor (rows,) on the source's light in each row of one frame."""
        factors = self._light.row_factors(rows, exposure_s, elapsed_s)
        return np.ones(rows) if factors is None else factors

    def row_factors_by_phase(self, rows: int, exposure_s: float, phases: int) -> FloatArray:
        """Return the same (phases, rows) of frames that begin at `phases` equally spaced times of one period, the
        longest of several.
        """
        period_s = max((law.period_s for law in self._light.rows), default=0.0)
        begins_s = period_s * np.arange(phases) / phases
        return np.array([self.row_factors(rows, exposure_s, float(t)) for t in begins_s])

    # --- charge ------------------------------------------------------------------------------------------------------

    def electrons(
        self,
        rates: Mapping[str, FloatArray | float],
        exposure_s: FloatArray | float,
        *,
        field: FieldPoints,
        elapsed_s: FloatArray | float = 0.0,
    ) -> dict[str, FloatArray]:
        """Mean electrons (..., points of `field`) by channel of light with `rates` (e/s on axis, with the effects on
        radiance and transmittance in them), dark current included. Rates, exposures and times of several captures have
        the same shape (...). `field` is that of `Uniform.field`.
        """
        collected_s = _of_each(self._charge.collected_s, exposure_s)
        source_s = _of_each(self._light.source, elapsed_s) * collected_s
        typical_s = source_s * float(np.mean(field.light))
        mixed = self._mix_captures({c: np.asarray(rates.get(c, 1.0)) * typical_s for c in self.camera.channels})
        dark = self.camera.dark_current_e_per_s * np.asarray(exposure_s)[..., None]
        lit = {}
        for channel, rate in rates.items():
            ambient = (self._light.ambient(channel) * collected_s)[..., None]
            detected = rate * _of_each(partial(self._light.colour, channel), elapsed_s)
            light = (detected * source_s)[..., None] * field.light
            if self.leaks:
                leaked = self.leaked_s(field) * field.light
                light = light + (detected * _of_each(self._light.source, elapsed_s))[..., None] * leaked
            lit[channel] = light + ambient
        strayed = self.stray_light(lit, field)
        return {c: light * mixed.get(c, np.ones(()))[..., None] + dark for c, light in strayed.items()}

    def stray_light(self, electrons: Mapping[str, FloatArray], points: FieldPoints) -> Mapping[str, FloatArray]:
        """Electrons of light (..., points) by channel after what misses its pixel fell on the next ones."""
        return self._charge.stray_channels(electrons, points.x_um, points.y_um)

    def stray_shares(self, channel: str, x_um: FloatArray, y_um: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shares of a channel's light that fall on the next pixels in the row, and in the column, at places."""
        both = [law.shares(channel, x_um, y_um) for law in self._charge.strays]
        return np.sum([along for along, _ in both], axis=0), np.sum([down for _, down in both], axis=0)

    def part_greens(self, electrons: Mapping[str, FloatArray], points: FieldPoints) -> FloatArray:
        """Return by how much green pixels on red rows have more electrons than those on blue rows, (..., points)."""
        return np.asarray(self._charge.part_greens(electrons, points.x_um, points.y_um) * np.ones(points.x_um.size))

    @property
    def strays(self) -> bool:
        """Return whether light falls on other pixels than its own."""
        return bool(self._charge.strays)

    def _mix_captures(self, electrons: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """`mixing_factors` of every capture."""
        if not self._charge.mixes:
            return {}
        level = dict(zip(electrons, np.broadcast_arrays(*electrons.values()), strict=True))
        shape = next(iter(level.values())).shape
        each = [self.mixing_factors({c: float(v[at]) for c, v in level.items()}) for at in np.ndindex(shape)]
        return {c: np.array([factors[c] for factors in each]).reshape(shape) for c in electrons}

    def mixing_factors(
        self, electrons: Mapping[str, float], at_px: tuple[float, float] | None = None
    ) -> dict[str, float]:
        """Factor on each channel's mean by charge that moves between neighbouring pixels, in even light of these
        electrons; empty where none moves. The mean is that of the frame, or that at the place `at_px` (row, column):
        packets far from the output leave more behind.
        """
        if not self._charge.mixes:
            return {}
        read = self._read_means(electrons, at_px)
        return {c: read[c] / level if level > 0 else 1.0 for c, level in electrons.items()}

    def _read_means(self, electrons: Mapping[str, float], at_px: tuple[float, float] | None = None) -> dict[str, float]:
        """Mean electrons that are read by channel, of even light of these; arguments as of `mixing_factors`."""
        down, across = (
            _lines_at(comb, None if at_px is None else at_px[axis]) for axis, comb in enumerate(self.read_combs())
        )
        read = down @ self.phases_of(electrons) @ across.T
        where = mosaic.phases(self.camera.cfa)
        return {c: sum(float(read[at]) for at in where[c]) / len(where[c]) for c in electrons}

    def phases_of(self, electrons: Mapping[str, float]) -> FloatArray:
        """Electrons (step, step) of the mosaic's phases after neighbouring pixels have shared those of even light, by
        channel, and before they are clocked out."""
        if self.exchanges_charge:
            return self._shared_phases(electrons)
        parts = self._phases_of_one
        return np.asarray(sum((e * parts[c] for c, e in electrons.items()), np.zeros(())))

    @cached_property
    def _phases_of_one(self) -> dict[str, FloatArray]:
        """`phases_of` one electron in each channel, where what neighbours share is in proportion."""
        channels = self.camera.channels
        return {one: self._shared_phases({c: float(c == one) for c in channels}) for one in channels}

    def _shared_phases(self, electrons: Mapping[str, float]) -> FloatArray:
        cfa, size, inner = self.camera.cfa, 12, slice(4, 8)
        tile = mosaic.assemble({c: np.full((size, size), level) for c, level in electrons.items()}, cfa)
        return phase_means(self._charge.move_charge(tile)[inner, inner], cfa)

    def read_combs(self) -> tuple[FloatArray, FloatArray]:
        """Electrons (step, rows) and (step, cols) that are read of the lines of each axis, given one electron in every
        line of one phase of the mosaic: even light P (step, step) by phase is read as down' P across, (rows, cols)."""
        step = mosaic.step(self.camera.cfa)
        return self._charge.read_combs(0, step), self._charge.read_combs(1, step)

    def light_of(self, read: Mapping[str, float]) -> dict[str, float]:
        """Electrons of even light by channel of which these means are read: the inverse of `mixing_factors`.

        Charge that unequal neighbours exchange isn't in proportion: the light is corrected until nothing changes."""
        if not self._charge.mixes:
            return dict(read)
        channels = self.camera.channels
        if not self.exchanges_charge:
            return dict(zip(channels, (self._unmixing @ [read[c] for c in channels]).tolist(), strict=True))
        light, least = dict(read), LEAST_UNMIXED * max(read.values(), default=0.0)
        for _ in range(MOST_UNMIXED):
            found = self._read_means(light)
            light = {c: max(value + read[c] - found[c], 0.0) for c, value in light.items()}
            if all(abs(read[c] - found[c]) <= least for c in light):
                break
        return light

    @cached_property
    def _unmixing(self) -> FloatArray:
        """Matrix from the means that are read to the light, by channel."""
        channels = self.camera.channels
        one = [self._read_means({c: float(c == lit) for c in channels}) for lit in channels]
        return np.linalg.inv(np.array([[read[c] for read in one] for c in channels]))

    @property
    def trails(self) -> bool:
        """Return whether packets leave charge behind on their way to the output."""
        return bool(self._charge.trails)

    def clock_profile(self, axis: Literal[0, 1], profile: FloatArray, margins: Margins) -> FloatArray:
        """Return the means of all lines of a frame along an axis, 0 of rows, 1 of columns, with its margins, as they
        are read, given those of the active lines (n,)."""
        return self._charge.clock_profile(axis, profile, margins)

    def exchanged_e(self, squares: FloatArray) -> FloatArray:
        """Change (n,) of the middle pixels' electrons by charge that unequal neighbours exchange. `squares`: (n, k, k)
        of k x k pixels, k odd, that hold all which the middle one exchanges charge with.
        """
        count, size, _ = squares.shape
        row = np.concatenate(list(squares), axis=1)
        after = reduce(lambda value, law: law(value), self._charge.exchange, row)
        return np.asarray((after - row).reshape(size, count, size)[size // 2, :, size // 2])

    @property
    def exchanges_charge(self) -> bool:
        """Return whether unequal neighbours exchange charge."""
        return bool(self._charge.exchange)

    @property
    def changes_dark_current(self) -> bool:
        """Return whether effects change the dark current of pixels that aren't defective."""
        return bool(self._charge.dark_current)

    def dark_e_per_s(self, temperature_c: float | None) -> FloatArray:
        """Dark current of every pixel (rows, cols), defective ones as the others, where the camera states it for that
        temperature.
        """
        rate = self._charge.even_dark_e_per_s(self.camera.dark_current_e_per_s, temperature_c)
        return np.broadcast_to(np.asarray(rate, float), (self.camera.rows, self.camera.cols))

    @property
    def hot(self) -> tuple[Defects, ...]:
        """Pixels with additional dark current, sizes in e/s."""
        return self._charge.defects

    @property
    def mean_hot_e_per_s(self) -> float:
        """Compute the defective pixels' part of the frame's mean dark current (electrons a second)."""
        return sum(float(np.mean(hot.sizes((self.camera.rows, self.camera.cols)))) for hot in self.hot)

    def lag_e(self, electrons: FloatArray) -> FloatArray | float:
        """Return how many of a frame's electrons stay for the next."""
        return self._charge.hold_lag(electrons)

    def released_e(self, begin_s: FloatArray, exposure_s: FloatArray, electrons: FloatArray) -> FloatArray:
        """Electrons that each of a series of frames collects from traps, which the frames before have filled.

        begin_s, exposure_s : of the frames in the order in which they are taken (n,)
        electrons : read in each, in k groups of pixels (n, k)

        Returns (n, k).
        """
        released_e = np.zeros(electrons.shape)
        for traps in self._charge.traps:
            held, end_s = np.zeros(electrons.shape[1]), 0.0
            for k, (start_s, open_s) in enumerate(zip(begin_s, exposure_s, strict=True)):
                released, left = traps.release(held, start_s - end_s, open_s)
                released_e[k] += released
                held, end_s = traps.fill(left, electrons[k]), start_s + open_s
        return released_e

    def shot_e2(self, electrons: FloatArray, gain_db: float = 0.0) -> FloatArray:
        """Variance of the shot noise (e^2) at mean signals, at a gain setting."""
        return self._charge.shot_e2(electrons) * self._charge.multiplication(gain_db).excess

    def excess_factor(self, gain_db: float = 0.0) -> float:
        """Return the factor on the shot noise's variance by which electrons are multiplied at random, at a gain
        setting."""
        return self._charge.multiplication(gain_db).excess

    def multiplied_skewness(self, gain_db: float = 0.0) -> float:
        """Return E g^3 / (E g^2)^2 of the number g by which an electron is multiplied at a gain setting: 1 of none."""
        return self._charge.multiplication(gain_db).skewness

    @property
    def changes_shot_noise(self) -> bool:
        """Return whether the shot noise's variance isn't that of the electrons."""
        return bool(self._charge.excess or self._charge.variance_e2)

    @property
    def particles(self) -> tuple[Particles, ...]:
        """Return the single particles that leave charge in frames."""
        return self._charge.particles

    @property
    def shares_shot_noise(self) -> bool:
        """Return whether neighbouring pixels' shot noise is correlated."""
        return bool(self._charge.correlation)

    def neighbour_correlation(self, electrons: FloatArray) -> FloatArray:
        """Correlation (5, ...) of a pixel's shot noise, at mean signals, with each neighbour, by `NEIGHBOURS`."""
        return self._charge.neighbour_correlation(electrons)

    # --- read-out ----------------------------------------------------------------------------------------------------

    @property
    def is_linear(self) -> bool:
        """Return whether the read-out's response is a straight line."""
        return not self._signal.response

    def response(self, electrons: FloatArray) -> FloatArray:
        """Apply the read-out's responses to signals in electrons."""
        return self._signal.read(electrons)

    def gain_map(self) -> FloatArray | None:
        """Factor (rows, cols) on what is read of every pixel in even light, without `line_gains`; None where it is the
        same for all."""
        shape = self.camera.rows, self.camera.cols
        gains = replace(self._signal, line_gains=()).gain_map(shape)
        if not self.amplifiers:
            return gains
        return self._signal.couple(np.ones(shape) if gains is None else gains)

    @property
    def amplifiers(self) -> tuple[CoupledAmplifiers, ...]:
        """How areas that are read at the same time couple."""
        return self._signal.amplifiers

    @property
    def line_gains(self) -> tuple[LineGains, ...]:
        """Factors on what is read of rows or columns, at random."""
        return self._signal.line_gains

    def line_gain_std(self, lines: Lines) -> float:
        """Relative standard deviation of the gains of rows or columns."""
        return float(np.sqrt(sum(gains.relative_std**2 for gains in self.line_gains if gains.lines == lines)))

    def offset_dn(self, elapsed_s: float, temperature_c: float | None, exposure_s: float) -> float:
        """DN added to the black level, beside the mean of `added_e`."""
        return self._signal.shift_dn(elapsed_s, temperature_c, exposure_s)

    @property
    def adds_signal(self) -> bool:
        """Return whether read-out adds signals of its own to the pixels (`Signal.disturbances`)."""
        return bool(self._signal.disturbances)

    @cached_property
    def added_e(self) -> FloatArray:
        """Mean of what read-out adds to every pixel, lit or dark (rows, cols)."""
        shape = self.camera.rows, self.camera.cols
        return sum(
            (np.asarray(disturbance.mean_e(shape)) for disturbance in self._signal.disturbances), np.zeros(shape)
        )

    @property
    def lines(self) -> tuple[LineNoise, ...]:
        """Noise that rows or columns share."""
        return self._signal.lines

    @property
    def reading_order(self) -> tuple[ReadOutNoise, ...]:
        """Noise in the order in which pixels are read."""
        return self._signal.reading_order

    @property
    def telegraph(self) -> tuple[Jumps, ...]:
        """Pixels that jump between two levels, sizes in e."""
        return self._signal.telegraph

    def read_kernel(self) -> FloatArray | None:
        """Kernel (odd,) along the row that makes read noise of white noise; None for none."""
        return self._signal.read_kernel()

    def read_power(self, frequency_cy_per_px: FloatArray) -> FloatArray:
        """Factor on the read noise's power at frequencies along the row."""
        return self._signal.read_power(frequency_cy_per_px)

    def filter_kernel(self) -> FloatArray | None:
        """Kernel (odd, odd) of all filters that the chip runs over each colour's plane; None for none."""
        return self._signal.filter_kernel()

    @property
    def has_even_codes(self) -> bool:
        """Return whether the converter is ideal."""
        return not self._codes.codes

    def codes(self, dn: FloatArray) -> FloatArray:
        """Convert levels in DN to the converter's, before it rounds."""
        return self._codes.convert(dn)

    def mean_dn(self, electrons: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Mean DN (...) above the black level over the points, by channel, after read-out of (..., points); codes are
        averaged over shot and read noise.
        """
        camera, means = self.camera, {}
        for channel, value in electrons.items():
            dn = camera.conversion_gain_dn_per_e * self.response(value)
            if not self.has_even_codes:
                noise = camera.conversion_gain_dn_per_e * np.sqrt(np.maximum(value, 0.0) + camera.read_noise_e**2)
                dn = self.codes(camera.black_level_dn + dn[..., None] + noise[..., None] * noise_values(dn.shape[-1]))
                dn = dn.mean(axis=-1) - camera.black_level_dn
            means[channel] = dn.mean(axis=-1)
        return means


def phase_means(tile: FloatArray, cfa: Cfa) -> FloatArray:
    """Means (step, step) of the phases of a mosaic's pixels, of a tile of whole periods."""
    step = mosaic.step(cfa)
    rows, cols = tile.shape
    return np.asarray(tile.reshape(rows // step, step, cols // step, step).mean((0, 2)))


def _lines_at(combs: FloatArray, at_px: float | None) -> FloatArray:
    """Electrons (step, step) that the lines of each phase read of those of each phase: means over all lines, or over
    the nearest ones of a place."""
    step, lines = combs.shape
    if at_px is None:
        return np.array([combs[:, phase::step].mean(1) for phase in range(step)])
    first = int(np.clip(round(at_px), 0, lines - step)) // step * step
    return np.asarray(combs[:, first : first + step].T)


def _of_each(law: Callable[[float], float], value: FloatArray | float) -> FloatArray:
    """Return a law of one number at every number of an array."""
    return np.array([law(float(number)) for number in np.ravel(value)]).reshape(np.shape(value))
