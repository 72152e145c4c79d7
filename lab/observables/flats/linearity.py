"""Levels of uniform light against the light: photon transfer's means, and how well levels repeat."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.capture_kinds.base import Capture
from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results import CameraFit, InconsistentLevel
from lab.observables.darks.level import added_dark_dn
from lab.observables.dataset import Dataset, held_out_flats
from lab.observables.flats.row_light import ROW_LIGHT, row_light_variance
from lab.observables.flats.stated_light import stated_light
from lab.observables.noise.line_means import LineMeans
from lab.observables.noise.repeatability import RepeatedMeans, level_std, repeated_levels, steady, weighted_median
from lab.observables.observable import LEVEL_REACH, Label, Measurement, Observable, Prediction
from lab.observables.reads import DARK_CURRENT, LAG, LINES, acting
from sim.effects.base import Effects
from sim.spectrum import FloatArray, Spectrum
from sim.uniform import LEVEL, SPECTRAL, Uniform, electron_rate

if TYPE_CHECKING:
    from lab.observables.dataset import Dataset


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
    (`lab.fit.noise.evaluation`)."""
    if fit is None or fit.noise is None:
        return ()
    return tuple(level for level in fit.noise.inconsistent_levels if level.light_unit == "photons" and level.captures)


# --- Linearity of flat fields: the mean level against the exposure, or against the number of photons ------------------


# Relative standard deviations.
LEVEL_FLOOR = 1.0e-4  # of a level, common to its repeats: nonlinearity of a linear camera
READING_COLOUR_STD = 5e-4  # of a radiometer's reading in one channel: its noise by wavelength
RADIOMETER_STD = 0.002  # of a radiometer's reading, common to the channels; the most that narrowband readings may have


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
    channels), and floor and rounding (common to repeats)."""
    noise = dataset.noise
    pixels = np.array([dataset.levels(c).pixels[channel] for c, channel, *_ in points])
    group_of = {c.id: i for i, group in enumerate(groups) for c in group}
    group = np.array([group_of[c.id] for c, *_ in points])
    channel_of = np.array([channel for _, channel, *_ in points])
    repeats = (group[:, None] == group) & (channel_of[:, None] == channel_of)
    covariance = np.diag((noise.gain * signal + noise.read_dn**2) / pixels)
    covariance += repeats * np.outer(signal, signal) * LEVEL_FLOOR**2
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


# ----------------------------------------------------------------------------------------------------------------------
# The scatter of repeated levels beyond that by pixels' noise and a steady lamp: whether the light changes from frame
# to frame.


#: Relative standard deviation of a steady lamp's light from frame to frame: data sheets of regulated halogen sources
#: and integrating spheres state 0.05 %, twice that at most. No finding by itself.
STEADY_LAMP = 5.0e-4
#: Least degrees of freedom of a number, and most numbers, each of settings of neighbouring exposures.
LEAST_FREEDOM, MOST_NUMBERS = 4, 4


def measure_level_repeats(dataset: Dataset) -> Observable:
    """(S / noise)^(1/3) of flat settings with repeats, pooled over neighbouring exposures.

    S is the variance of a setting's relative levels, with f = n - 1 degrees of freedom; noise its expectation by the
    noise of pixels. The cube root of chi2_f / f is all but normal, of mean 1 - 2 / (9 f) and variance 2 / (9 f), also
    for few degrees of freedom, where a logarithm would hide much of a large variance (Wilson and Hilferty, PNAS 17,
    684, 1931). The means of dark frames scatter, as rows of one frame share noise of low frequencies and black levels
    jump; by the same DN^2 do those of flats. Nuisance parameters: that variance (`_dark_scatter`); a lamp's usual
    unsteadiness, whose variance is uncertain by s0^2, s0 = `STEADY_LAMP`; and how much wider S scatters the larger it
    is. Image lag adds to S what each repeat's predecessor leaves in it. Settings out of line with the others are left
    out (`steady`): other measurements find those. Raises NotDetermined for fewer than `LEAST_FREEDOM` degrees of
    freedom."""
    groups = _by_exposure(_seen(dataset))
    if not groups:
        raise NotDetermined(
            "level_repeats",
            f"fewer than {LEAST_FREEDOM + 1} repeats of flat settings: how steady the light is can't be told; repeat "
            "one setting ten times",
        )
    freedom = np.array([sum(len(r.away) - 1 for r in group) for group in groups], float)
    noise = np.array([_weighted(group, [r.noise for r in group]) for group in groups])
    square = np.array([sum(float(np.sum(np.square(r.away))) for r in group) for group in groups]) / freedom
    value = np.cbrt(square / noise)
    variance = 2.0 / (9.0 * freedom)
    exposure_s = np.array([_weighted(group, [r.captures[0].exposure_s for r in group]) for group in groups])

    per_dn2 = np.array([_weighted(group, [r.signal_dn**-2 for r in group]) for group in groups])
    dark_dn2, dark_std_dn2 = _dark_scatter(dataset)

    def predict(effects: Effects) -> Prediction:
        model = Uniform(dataset.camera, effects)
        more = dark_dn2 * per_dn2 + np.array(
            [model.unsteadiness**2 + row_light_variance(model, dataset.camera.rows, float(t)) for t in exposure_s]
        )
        if acting(effects, LAG):
            more = more + np.array([_of_lag(dataset, effects, group) for group in groups])
        root = np.cbrt(1.0 + more / noise)
        usual = np.cbrt(1.0 + (more + STEADY_LAMP**2) / noise) - root
        darker = np.cbrt(1.0 + (more + dark_std_dn2 * per_dn2) / noise) - root
        wider = np.diag(np.sqrt(variance * (np.square(root) - 1.0)))
        scatter = {f"scatter of repeats {number}": column for number, column in enumerate(wider)}
        usually = {"usual unsteadiness of the lamp": usual, "scatter of dark frames": darker}
        return Prediction(root * (1.0 - variance), usually | scatter)

    labels = tuple(
        Label(float(np.log(t)), "all", f"{t:.4g} s", tuple(c.id for r in group for c in r.captures), held_out=False)
        for t, group in zip(exposure_s, groups, strict=True)
    )
    return Observable(
        measurement=LEVEL_REPEATS, reach=1.0, value=value, covariance=np.diag(variance), labels=labels,
        reads=frozenset({"light.unsteadiness"}) | ROW_LIGHT | LAG, predict=predict, scale=np.ones(len(value)),
    )  # fmt: skip


def _seen(dataset: Dataset) -> list[RepeatedMeans]:
    """Return the repeats that aren't held out, of settings in line with each other (`steady`)."""
    noise, out = dataset.noise, dataset.once(held_out_flats)
    found = []
    for one in repeated_levels(dataset, noise.black, noise.gain, noise.read_dn):
        kept = [i for i, c in enumerate(one.captures) if c.id not in out]
        if len(kept) > 1:
            captures, elapsed = tuple(one.captures[i] for i in kept), one.elapsed_s[kept]
            away = one.away[kept] - one.away[kept].mean()
            found.append(RepeatedMeans(captures, away, elapsed, one.noise, one.signal_dn))
    return steady(found)


def _dark_scatter(dataset: Dataset) -> tuple[float, float]:
    """Variance of a dark frame's mean beside that by the noise of independent pixels, DN^2, and its standard deviation.

    Without repeated dark frames it may be as large as rows leave whose noise is that of their pixels.
    """
    noise = dataset.noise
    if noise.jitter_dn2_std == 0.0:
        return 0.0, max(noise.jitter_dn**2, noise.read_dn**2 / dataset.camera.rows)
    return noise.jitter_dn**2, noise.jitter_dn2_std


def _by_exposure(repeats: list[RepeatedMeans]) -> list[list[RepeatedMeans]]:
    """Settings in the order of their exposure, in at most `MOST_NUMBERS` groups of at least `LEAST_FREEDOM` degrees of
    freedom."""
    ordered = sorted(repeats, key=lambda r: (r.captures[0].exposure_s, r.captures[0].id))
    whole = sum(len(r.away) - 1 for r in ordered)
    wanted = max(LEAST_FREEDOM, -(-whole // MOST_NUMBERS))
    groups: list[list[RepeatedMeans]] = []
    free = wanted
    for one in ordered:
        if free >= wanted:
            groups.append([])
            free = 0
        groups[-1].append(one)
        free += len(one.away) - 1
    if groups and free < LEAST_FREEDOM:
        last = groups.pop()
        if groups:
            groups[-1].extend(last)
    return groups


def _weighted(group: list[RepeatedMeans], value: list[float]) -> float:
    """Mean over settings, weighted by their degrees of freedom."""
    return float(np.average(value, weights=[len(r.away) - 1 for r in group]))


def _of_lag(dataset: Dataset, effects: Effects, group: list[RepeatedMeans]) -> float:
    """Variance that image lag adds to the repeats' relative levels about the mean of each setting, as the first repeat
    often follows another level."""
    carried, total = dataset.carried_e(effects), 0.0
    for repeats in group:
        signal_e = [
            sum(max(v - dataset.noise.black, 1e-9) for v in dataset.levels(c).whole.values()) / dataset.noise.gain
            for c in repeats.captures
        ]
        added_e = [sum(carried(c, channel) for channel in dataset.levels(c).whole) for c in repeats.captures]
        share = np.array(added_e) / np.array(signal_e)
        total += float(np.sum(np.square(share - share.mean())))
    return total / sum(len(r.away) - 1 for r in group)


LEVEL_REPEATS = Measurement(
    "level_repeats",
    title="scatter of repeated levels",
    order=205,
    axis="exposure",
    unit="log s",
    make=measure_level_repeats,
    quantity="variance over noise, cube root",
    of_variances=True,
)
