"""Levels of uniform light against the light: the means of photon transfer."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results import CameraFit, InconsistentLevel
from lab.observables.darks.level import added_dark_dn
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.stated_light import stated_light
from lab.observables.noise.line_means import LineMeans
from lab.observables.noise.repeatability import level_std, weighted_median
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES, acting
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.effects.base import Effects
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL, Uniform, electron_rate


class UniformLevels:
    """Mean levels of n pairs of capture and channel. `captures` lists each capture once."""

    def __init__(self, dataset: Dataset, points: Sequence[tuple[Capture, str]]) -> None:
        """`points`: n of (capture, channel)."""
        self._dataset = dataset
        self.captures: tuple[Capture, ...] = tuple({capture.id: capture for capture, _ in points}.values())
        number = {capture.id: i for i, capture in enumerate(self.captures)}
        self._of = np.array([number[capture.id] for capture, _ in points])
        self._points = tuple(points)
        self._channel = np.array([channel for _, channel in points])
        self._exposure_s = np.array([capture.exposure_s for capture in self.captures])
        self._elapsed_s = np.array([dataset.elapsed_s(capture) for capture in self.captures])
        self.lines = LineMeans(dataset, points)

    def of_light_dn(self, effects: Effects, rates: Mapping[str, FloatArray]) -> FloatArray:
        """DN (n,) by light and the baseline's dark current, after read-out. `rates`: channel -> electrons a second on
        axis, (captures,)."""
        model = Uniform(self._dataset.camera, effects)
        field = model.field(self._dataset.field)
        electrons = model.electrons(rates, self._exposure_s, field=field, elapsed_s=self._elapsed_s)
        found = np.empty(len(self._of))
        for channel, dn in model.mean_dn(electrons).items():
            mine = self._channel == channel
            found[mine] = dn[self._of[mine]]
        return found

    def beside_light_dn(self, effects: Effects) -> FloatArray:
        """DN (n,) by all else: black level, offsets, image lag, and dark current that effects add."""
        dataset = self._dataset
        offset, dark, carried = dataset.offset(effects), added_dark_dn(dataset, effects), dataset.carried_e(effects)
        of_capture = np.array([dataset.noise.black + offset(capture) + dark(capture) for capture in self.captures])
        lag_e = np.array([carried(capture, channel) for capture, channel in self._points])
        return np.asarray(of_capture[self._of] + dataset.noise.gain * lag_e)


# --- The stated light of flats: a measured radiance, or a number of photons a pixel -----------------------------------


@dataclass(frozen=True)
class FlatLight:
    """One statement of the light: a radiometer's reading, or a number of photons in an exposure."""

    name: str
    lamp: Hashable  # equal for readings of the same lamp
    path: str | None = None  # of the spectrum that the radiometer read
    photons_per_s: float = 0.0  # a pixel, where no spectrum is stated


def reading(dataset: Dataset, flat: FlatCapture) -> FlatLight | None:
    """Return the stated light of a flat; None where nothing is stated, or where exposure or photon number is 0."""
    if flat.radiance is not None:
        return FlatLight(flat.radiance, dataset.lamps[flat.radiance], flat.radiance)
    light = stated_light(flat)
    if light.unit != "photons" or flat.exposure_s <= 0 or light.amount <= 0:
        return None
    name = f"{light.amount:.9g} photons in {flat.exposure_s:.9g} s"
    return FlatLight(name, light.lamp, None, light.amount / flat.exposure_s)


def relative_rates(dataset: Dataset, readings: Sequence[FlatLight]) -> Mapping[tuple[str, str], float]:
    """(reading, channel) -> electron rate (photon rate, where photons are stated) over that by the first reading of the
    same lamp."""
    first: dict[Hashable, FlatLight] = {}
    for one in readings:
        first.setdefault(one.lamp, one)
    found = {}
    for channel in dataset.channels:
        rate = {one.name: _rate(dataset, one, channel) for one in readings}
        for one in readings:
            found[one.name, channel] = rate[one.name] / max(rate[first[one.lamp].name], 1e-300)
    return found


def _rate(dataset: Dataset, one: FlatLight, channel: str) -> float:
    if one.path is None:
        return one.photons_per_s
    spectrum: Spectrum = dataset.spectrum(one.path)
    return electron_rate(dataset.camera, channel, spectrum)


def misstated_levels(fit: CameraFit | None) -> tuple[InconsistentLevel, ...]:
    """Levels whose stated number of photons contradicts the others, as found by the noise fit
    (`lab.fit.noise.consistency`)."""
    if fit is None or fit.noise is None:
        return ()
    return tuple(level for level in fit.noise.inconsistent_levels if level.light_unit == "photons" and level.captures)


# --- Linearity of flat fields: the mean level against the exposure, or against the number of photons ------------------


# Relative standard deviations.
READING_COLOUR_STD = 5e-4  # of a radiometer's reading in one channel: its noise by wavelength


def measure_photon_transfer(dataset: Dataset) -> Observable:
    """Mean of every unclipped flat frame by channel, DN, against the exposure, or the number of photons where that is
    stated.

    Nuisance parameters: black level, dark current, the electron rate of each channel in each lamp, and the radiometer's
    readings. What remains is nonlinearity. Raises NotDetermined for flats without stated light, for fewer than three
    levels, and where fewer than four means are unclipped.
    """
    groups = [
        g for g in dataset.flat_levels() if reading(dataset, g[0]) is not None and g[0].id not in dataset.misstated
    ]
    if not groups and dataset.flat_levels():
        raise NotDetermined(
            "photon_transfer", "flat captures without a radiance file or photon numbers: their levels aren't comparable"
        )
    if len({(g[0].exposure_s, g[0].photons_per_pixel) for g in groups}) < 3:
        raise NotDetermined("photon_transfer", "fewer than three levels of flat captures")
    points = _flat_points(dataset, groups)
    if len(points) < 4:
        raise NotDetermined("photon_transfer", "almost all flat captures are clipped: expose them shorter")
    exposures = np.array([c.exposure_s for c, *_ in points])
    value = np.array([mean for _, _, mean, _ in points])
    noise = dataset.noise
    signal = np.maximum(value - noise.black - noise.dark_dn_per_s * exposures, 1e-3)
    of = {c.id: found for c, *_ in points if (found := reading(dataset, c)) is not None}
    readings = list({one.name: one for one in of.values()}.values())
    # readings of a lamp against its first one, by channel: the change of the lamp between passes
    relative = relative_rates(dataset, readings)
    key = [(of[c.id].lamp, channel) for c, channel, *_ in points]
    scaled = exposures * np.array([relative[of[c.id].name, channel] for c, channel, *_ in points])
    rate = {}
    for pair in dict.fromkeys(key):
        mine = np.array([k == pair for k in key])
        low = mine & (signal < 0.6 * (dataset.saturation_dn - noise.black))
        use = low if low.sum() > 1 else mine
        # the median isn't moved by a level that contradicts the others
        typical = weighted_median(signal[use] / scaled[use], scaled[use])
        rate[pair] = typical / noise.gain / float(dataset.field.light.mean())
    covariance = _level_covariance(dataset, dataset.flat_levels(), points, signal)

    levels = UniformLevels(dataset, [(c, channel) for c, channel, *_ in points])
    lights = [of[c.id] for c in levels.captures]
    baseline = {c: np.array([rate.get((one.lamp, c), 0.0) for one in lights]) for c in dataset.channels}
    of_lamp = {(lamp, channel): np.array([k == (lamp, channel) for k in key]) for lamp, channel in rate}
    of_reading = _of_readings(dataset, readings, [of[c.id] for c, *_ in points], [channel for _, channel, *_ in points])

    def predict(effects: Effects) -> Prediction:
        changed = _changed(dataset, readings, relative, effects)
        rates = {c: level * np.array([changed[one.name, c] for one in lights]) for c, level in baseline.items()}
        light_dn = levels.of_light_dn(effects, rates)
        lit = light_dn - noise.dark_dn_per_s * exposures

        def jacobian() -> dict[str, FloatArray]:
            found = dataset.free_offsets(exposures) | dataset.free_warmth([c for c, *_ in points])
            found |= levels.lines.jacobian(effects)
            found |= {f"rate:{lamp}:{channel}": 0.05 * lit * mine for (lamp, channel), mine in of_lamp.items()}
            return found | {name: std * lit * mine for name, (std, mine) in of_reading.items()}

        return Prediction(light_dn + levels.beside_light_dn(effects), jacobian)

    return Observable(
        measurement=PHOTON_TRANSFER, reach=LEVEL_REACH, along=np.log(np.maximum(signal, 1.0)), value=value,
        covariance=covariance,
        labels=tuple(Label(float(v), channel, _setting(c), (c.id,), out) for (c, channel, _, out), v in zip(points,
        value, strict=True)),
        reads=LEVEL | LAG | DARK_CURRENT, scattered_by=LINES, predict=predict, scale=signal,
    )  # fmt: skip


def _changed(
    dataset: Dataset, readings: list[FlatLight], relative: Mapping[tuple[str, str], float], effects: Effects
) -> Mapping[tuple[str, str], float]:
    """`relative` rates, (reading, channel) -> rate over that by the lamp's first reading, as effects on the spectrum
    change them.

    Light stated in photons changes by the same factor at all levels, which is part of its free rate.
    """
    if not acting(effects, SPECTRAL):
        return relative
    changed = dict(relative)
    for one in readings:
        for channel in dataset.channels if one.path is not None else ():
            below = electron_rate(dataset.camera, channel, dataset.spectrum(one.path or ""))
            above = electron_rate(dataset.camera, channel, dataset.spectrum(one.path or ""), effects)
            changed[one.name, channel] *= above / below if below > 0 else 1.0
    return changed


def _of_readings(
    dataset: Dataset, readings: list[FlatLight], lights: list[FlatLight], channels: list[str]
) -> dict[str, tuple[float, np.ndarray]]:
    """Nuisance parameters of the radiometer's readings: name -> (relative prior standard deviation, mask (n,) of the
    means it changes).

    One for each reading, and one for each reading and channel. None where every lamp was read once, as its free rate
    covers that."""
    found: dict[str, tuple[float, np.ndarray]] = {}
    if len(readings) == len({one.lamp for one in readings}):
        return found
    for one in readings:
        read_there = np.array([light == one for light in lights])
        found[f"reading:{one.name}"] = RADIOMETER_STD, read_there
        for channel in dataset.channels if len(dataset.channels) > 1 and one.path is not None else ():
            mine = read_there & np.array([c == channel for c in channels])
            found[f"reading:{one.name}:{channel}"] = READING_COLOUR_STD, mine
    return found


def _level_covariance(dataset: Dataset, groups: list[list[Any]], points: list[Any], signal: FloatArray) -> FloatArray:
    """Covariance (n, n) of flat frames' means, DN^2: shot and read noise, the lamp's repeatability (common to a frame's
    channels), and rounding (common to repeats)."""
    noise = dataset.noise
    pixels = np.array([dataset.levels(c).pixels[channel] for c, channel, *_ in points])
    group_of = {c.id: i for i, group in enumerate(groups) for c in group}
    group = np.array([group_of[c.id] for c, *_ in points])
    channel_of = np.array([channel for _, channel, *_ in points])
    repeats = (group[:, None] == group) & (channel_of[:, None] == channel_of)
    covariance = np.diag((noise.gain * signal + noise.read_dn**2) / pixels)
    rounding = noise.rounding_std_dn(signal)
    covariance += repeats * np.outer(rounding, rounding)
    same = np.array([[a[0].id == b[0].id for b in points] for a in points])
    lamp = signal * level_std(dataset, groups)[group]
    covariance += same * (np.outer(lamp, lamp) + noise.jitter_dn**2)
    return np.asarray(covariance)


def _setting(capture: FlatCapture) -> str:
    """Return the setting of a flat in words: exposure, and photons where they are stated."""
    if capture.photons_per_pixel is None:
        return f"{capture.exposure_s:.4g} s"
    return f"{capture.photons_per_pixel:.6g} photons, {capture.exposure_s:.4g} s"


def _flat_points(dataset: Dataset, groups: list[list[Any]]) -> list[tuple[Any, str, float, bool]]:
    """(capture, channel, mean in DN, held out) of all unclipped channels of flat frames."""
    points = []
    out = dataset.once(held_out_flats)
    for group in groups:
        for capture in group:
            for channel in dataset.channels:
                mean = dataset.levels(capture).mean[channel]
                if mean is not None:
                    points.append((capture, channel, mean, capture.id in out))
    return points


PHOTON_TRANSFER = Measurement(
    "photon_transfer",
    title="linearity of flat fields",
    order=200,
    axis="level",
    unit="DN",
    make=measure_photon_transfer,
    quantity="mean level, DN",
    is_level=True,
)
