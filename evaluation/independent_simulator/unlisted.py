"""Twenty laws that no list of effects has, each with a declaration of where it acts and along what it is simple.

Each is physics that laboratories meet, written without a search in mind. A proof of discovery conceals them
(`evaluation.unlisted`)."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from evaluation.independent_simulator.law import DARK, SPECTRAL, WAVELENGTH_NM, Array, Law

Stage = Literal["light", "image", "charge", "signal", "codes"]
#: What changes along the axes: a sum added to the mean, a factor on it, the variance, the covariance of neighbours,
#: the widths of codes.
Acts = Literal["offset", "factor", "variance", "covariance", "widths"]


class UnlistedLaw(Law):
    """A law of no list, and what is true of it.

    `stage`: where it acts; `alike`: stages from which no recording of these sizes tells it (a factor of some per cent
    on light, charge or signal). `axes`: the indices of which the law is a function, each with the words that mean the
    same here, the first its name; `beside`: indices that a right answer may have besides. `periods`: of the axes, in
    their order, where the law repeats; 0 where it doesn't."""

    stage: ClassVar[Stage]
    alike: ClassVar[frozenset[Stage]] = frozenset()
    acts: ClassVar[Acts]
    axes: ClassVar[tuple[tuple[str, ...], ...]]
    beside: ClassVar[frozenset[str]] = frozenset()
    periods: ClassVar[tuple[int, ...]] = ()

    def balanced(self, *shape: int) -> Array:
        """Random numbers of mean 0 and rms 1, the law's own."""
        table = self.rng(20).uniform(-1.0, 1.0, shape)
        table -= table.mean()
        return table / np.sqrt(np.mean(table**2))


# --- light -----------------------------------------------------------------------------------------------------------


class SaddleShadingLaw(UnlistedLaw):
    """A rectangular port of the sphere: the light is a saddle over the field, a r^2 cos 2(angle - angle0), r = 1 at
    the corner."""

    name, unit, nominal, limits = "saddle_shading", "%", 0.5, (0.002, 20.0)
    families = frozenset({"field_of_light"})
    stage, acts, axes, beside = "light", "factor", (("angle", "place"),), frozenset({"radius"})
    alike = frozenset({"charge", "signal", "image"})

    def relative_response(self, x: Array, y: Array) -> Array:
        angle = 2.0 * (np.arctan2(y, x) - np.pi * self.uniform[0])
        return 1.0 + self.strength / 100.0 * (np.square(x) + np.square(y)) * np.cos(angle)


class ScrewErrorLaw(UnlistedLaw):
    """The screw of the monochromator's grating is uneven: its line is displaced by a sine of the wavelength, of period
    50 nm, and the radiometer shares the error."""

    name, unit, nominal, limits, shown_by = "screw_error", "nm", 0.3, (0.002, 8.0), SPECTRAL
    families = frozenset({"source_in_wavelength"})
    stage, acts, axes = "light", "factor", (("wavelength",),)

    def displacement_nm(self, wavelength_nm: float) -> float:
        """Of the line at a wavelength."""
        return self.strength * float(np.sin(2 * np.pi * (wavelength_nm / 50.0 + self.uniform[0])))

    def radiance(self, radiance: Array, kind: str) -> Array:
        if kind != "narrowband":
            return radiance
        centre = float((radiance * WAVELENGTH_NM).sum() / radiance.sum())
        return np.interp(WAVELENGTH_NM - self.displacement_nm(centre), WAVELENGTH_NM, radiance)


class ReddeningLampLaw(UnlistedLaw):
    """The lamp cools: red light rises and blue light falls linearly with the time, green stays."""

    name, unit, nominal, limits, needs, signed = "reddening_lamp", "%/(10 min)", 0.3, (0.002, 20.0), "bayer", True
    families = frozenset({"source_in_time"})
    stage, acts, axes = "light", "factor", (("plane", "wavelength"), ("time", "frame"))
    alike = frozenset({"charge", "signal"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        out = electrons.copy()
        for k, colour in enumerate(self.camera.cfa):
            turn = {"R": 1.0, "B": -1.0}.get(colour, 0.0)
            out[k // 2 :: 2, k % 2 :: 2] *= 1.0 + turn * self.signed_strength / 100.0 * self.frame.elapsed_s / 600.0
        return out


class LeafShutterLaw(UnlistedLaw):
    """A leaf shutter opens from the middle: the centre is lit longer than the corners, by a fixed time. The stated
    exposure is the field's mean."""

    name, unit, nominal, limits = "leaf_shutter", "us", 1.0, (0.002, 2000.0)
    families = frozenset({"field_of_light", "response_to_light"})
    stage, acts, axes = "light", "factor", (("radius", "place"), ("exposure", "level"))
    alike = frozenset({"charge"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        x, y = self.camera.field_position
        inwards = 1.0 - (np.square(x) + np.square(y))
        return electrons + rate_e_per_s * self.strength * 1e-6 * (inwards - inwards.mean())


# --- charge ----------------------------------------------------------------------------------------------------------


class WavyColumnsLaw(UnlistedLaw):
    """The implant's dose varies: the response is a sine along the columns, of period 37 px."""

    name, unit, nominal, limits = "wavy_columns", "%", 0.1, (0.001, 20.0)
    families = frozenset({"field_of_light"})
    stage, acts, axes, periods = "charge", "factor", (("column",),), (37,)
    alike = frozenset({"light", "signal"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        turns = np.arange(electrons.shape[1]) / self.periods[0] + self.uniform[0]
        return electrons * (1.0 + self.strength / 100.0 * np.sin(2 * np.pi * turns))[None, :]


class WarmCentreLaw(UnlistedLaw):
    """A processor below the sensor warms its middle: dark current a (1 - r^2), r = 1 at the corner, beside the even
    one."""

    name, unit, nominal, limits, shown_by = "warm_centre", "e/s", 1.0, (0.002, 400.0), DARK
    families = frozenset({"dark_signal"})
    stage, acts, axes, beside = "charge", "offset", (("radius", "place"),), frozenset({"exposure"})

    def dark_rate(self, rate_e_per_s: Array, temperature_c: float) -> Array:
        x, y = self.camera.field_position
        return rate_e_per_s + self.strength * (1.0 - np.square(x) - np.square(y))


class ChargePocketLaw(UnlistedLaw):
    """A pocket on the way to the sense node keeps the first charges back: a (1 - exp(-e / e0)), e0 = 6 % of full
    well."""

    name, unit, nominal, limits = "charge_pocket", "e", 3.0, (0.01, 400.0)
    families = frozenset({"response_to_light"})
    stage, acts, axes, alike = "charge", "offset", (("level",),), frozenset({"signal"})

    def drawn_e(self, electrons: Array, mean_e: Array) -> Array:
        filled = np.maximum(electrons, 0.0) / (0.06 * self.camera.full_well_e)
        return electrons + self.strength * np.expm1(-filled)


class SharedCellLaw(UnlistedLaw):
    """Eight pixels, two rows by four columns, share a sense node, and each has its own response by its place in that
    cell."""

    name, unit, nominal, limits = "shared_cell", "%", 0.1, (0.001, 20.0)
    stage, acts, axes, periods = "charge", "factor", (("row",), ("column",)), (2, 4)
    alike = frozenset({"light", "signal"})

    def collected_e(self, electrons: Array, rate_e_per_s: Array) -> Array:
        rows, cols = electrons.shape
        cell = np.tile(self.balanced(2, 4), (rows // 2 + 1, cols // 4 + 1))[:rows, :cols]
        return electrons * (1.0 + self.strength / 100.0 * cell)


# --- signal ----------------------------------------------------------------------------------------------------------


class RowBanksLaw(UnlistedLaw):
    """Rows are driven in eight banks, each with its own offset."""

    name, unit, nominal, limits, shown_by = "row_banks", "DN", 0.1, (0.0005, 30.0), DARK
    families = frozenset({"dark_signal", "line_noise"})
    stage, acts, axes, periods = "signal", "offset", (("row",),), (8,)

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        bank = self.balanced(8)[np.arange(shape[0]) % 8]
        return np.broadcast_to(self.strength / self.camera.gain_dn_per_e * bank[:, None], shape)


class ColumnAmplifiersLaw(UnlistedLaw):
    """Columns are read by four amplifiers in turn, each with its own gain."""

    name, unit, nominal, limits = "column_amplifiers", "%", 0.1, (0.001, 20.0)
    stage, acts, axes, periods = "signal", "factor", (("column",),), (4,)
    alike = frozenset({"light", "charge"})

    def response(self, electrons: Array) -> Array:
        return electrons * (1.0 + self.strength / 100.0 * self.balanced(4)[np.arange(electrons.shape[1]) % 4])[None, :]


class ResetSettlingLaw(UnlistedLaw):
    """The reset settles while the frame is exposed: an offset a exp(-t / tau) of the exposure t, tau between 0.3 and 1
    ms."""

    name, unit, nominal, limits, shown_by = "reset_settling", "DN", 1.0, (0.002, 60.0), frozenset({"dark", "flat"})
    families = frozenset({"dark_signal"})
    stage, acts, axes, signed = "signal", "offset", (("exposure",),), True

    @property
    def tau_s(self) -> float:
        """The time of settling."""
        return 1e-3 * (0.3 + 0.7 * float(self.uniform[0]))

    def offset_dn(self, elapsed_s: float, temperature_c: float) -> float:
        return self.signed_strength * float(np.exp(-self.frame.exposure_s / self.tau_s))


class FirstRowsLaw(UnlistedLaw):
    """The read-out settles after the frame's beginning: an offset a exp(-row / 12)."""

    name, unit, nominal, limits, shown_by, signed = "first_rows", "DN", 0.5, (0.002, 60.0), DARK, True
    families = frozenset({"dark_signal", "line_noise"})
    stage, acts, axes = "signal", "offset", (("row",),)

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        course = self.signed_strength / self.camera.gain_dn_per_e * np.exp(-np.arange(shape[0]) / 12.0)
        return np.broadcast_to(course[:, None], shape)


class WarmingNoiseLaw(UnlistedLaw):
    """The amplifiers warm up: the variance of the read noise grows linearly with the time, by the strength squared in
    10 minutes."""

    name, unit, nominal, limits, power = "warming_noise", "e", 2.0, (0.05, 100.0), 2.0
    shown_by = frozenset({"dark", "flat"})
    stage, acts, axes = "signal", "variance", (("time", "frame"),)

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        return self.strength * np.sqrt(self.frame.elapsed_s / 600.0) * self.rng(21, k).standard_normal(shape)


class MidLevelNoiseLaw(UnlistedLaw):
    """A comparator hesitates where two ranges meet: extra noise about half of full well, of width 10 %."""

    name, unit, nominal, limits, power = "mid_level_noise", "e", 15.0, (0.5, 400.0), 2.0
    stage, acts, axes, alike = "signal", "variance", (("level",),), frozenset({"charge"})

    def response(self, electrons: Array) -> Array:
        away = (electrons / self.camera.full_well_e - 0.5) / 0.1
        noise = self.rng(22, self.frame.draw).standard_normal(electrons.shape)
        return electrons + self.strength * np.exp(-0.5 * np.square(away)) * noise


class BankNoiseLaw(UnlistedLaw):
    """Odd columns are read at the other side of the sensor, by noisier converters."""

    name, unit, nominal, limits, power, shown_by = "bank_noise", "e", 1.0, (0.05, 100.0), 2.0, DARK
    stage, acts, axes, periods = "signal", "variance", (("column",),), (2,)

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        return self.strength * self.rng(23, k).standard_normal(shape) * (np.arange(shape[1]) % 2)[None, :]


class SharedReadLaw(UnlistedLaw):
    """Rows are read in pairs: a pixel and the one below it, in the other row of the pair, share a part of their
    noise."""

    name, unit, nominal, limits, power, shown_by = "shared_read", "e", 1.0, (0.05, 100.0), 2.0, DARK
    families = frozenset({"line_noise"})
    stage, acts, axes, periods = "signal", "covariance", (("row",),), (2,)

    def noise_e(self, shape: tuple[int, int], k: int) -> Array:
        pairs = self.rng(24, k).standard_normal(((shape[0] + 1) // 2, shape[1]))
        return self.strength * np.repeat(pairs, 2, axis=0)[: shape[0]]


class BentColumnsLaw(UnlistedLaw):
    """The column amplifiers bend, each its own way: an offset of the column that grows with the square of the level."""

    name, unit, nominal, limits = "bent_columns", "%", 0.1, (0.002, 20.0)
    families = frozenset({"response_to_light"})
    stage, acts, axes = "signal", "factor", (("column",), ("level",))

    def response(self, electrons: Array) -> Array:
        full = self.camera.full_well_e
        bend = self.strength / 100.0 * self.balanced(electrons.shape[1])[None, :]
        return electrons + bend * full * np.square(electrons / full)


# --- codes -----------------------------------------------------------------------------------------------------------


def coded(dn: Array, begins: Array) -> Array:
    """Return the codes of a converter whose thresholds repeat every len(begins) codes: code n of a period begins at
    begins[n], in codes from the period's first threshold of an even converter. The first may be negative, and the last
    may end later by as much."""
    period = len(begins)
    left = np.clip(dn + 0.5 - begins[0], 0.0, None)
    return period * (left // period) + np.searchsorted(begins - begins[0], left % period, side="right") - 1.0


class RingCodesLaw(UnlistedLaw):
    """The converter counts with a ring oscillator of five stages: its ten phases, and so the widths of codes, are
    unequal."""

    name, unit, nominal, limits = "ring_codes", "DN", 0.05, (0.001, 0.4)
    families = frozenset({"converter"})
    stage, acts, axes, periods = "codes", "widths", (("code",),), (10,)

    @property
    def widths(self) -> Array:
        """Of the ten codes; the strength is the rms of their departures."""
        return np.maximum(1.0 + self.strength * self.balanced(10), 0.01)

    def adc_output(self, dn: Array) -> Array:
        width = 10.0 * self.widths / self.widths.sum()
        return coded(dn, np.append(0.0, np.cumsum(width)[:-1]))


class CoarseTopLaw(UnlistedLaw):
    """The converter saves time on strong signals: from three quarters of its range on, odd codes are narrower and even
    ones wider."""

    name, unit, nominal, limits = "coarse_top", "DN", 0.1, (0.002, 0.95)
    families = frozenset({"converter"})
    stage, acts, axes, periods = "codes", "widths", (("code",),), (2,)
    beside = frozenset({"level"})

    def adc_output(self, dn: Array) -> Array:
        coarse = coded(dn, np.array([-0.5 * self.strength, 1.0 + 0.5 * self.strength]))
        return np.where(dn < 0.75 * (self.camera.full_code_dn + 1.0), dn, coarse)


class WideCarriesLaw(UnlistedLaw):
    """A counter's carry comes early: every 64th code begins before its time, at the cost of the code before."""

    name, unit, nominal, limits = "wide_carries", "DN", 0.3, (0.005, 0.95)
    families = frozenset({"converter"})
    stage, acts, axes, periods = "codes", "widths", (("code",),), (64,)

    def adc_output(self, dn: Array) -> Array:
        begins = np.arange(64.0)
        begins[0] -= self.strength
        return coded(dn, begins)


#: Laws that no effect describes, in the order in which the proof of discovery deals them.
UNLISTED: tuple[type[UnlistedLaw], ...] = (
    SaddleShadingLaw,
    ScrewErrorLaw,
    ReddeningLampLaw,
    LeafShutterLaw,
    WavyColumnsLaw,
    WarmCentreLaw,
    ChargePocketLaw,
    SharedCellLaw,
    RowBanksLaw,
    ColumnAmplifiersLaw,
    ResetSettlingLaw,
    FirstRowsLaw,
    WarmingNoiseLaw,
    MidLevelNoiseLaw,
    BankNoiseLaw,
    SharedReadLaw,
    BentColumnsLaw,
    RingCodesLaw,
    CoarseTopLaw,
    WideCarriesLaw,
)
