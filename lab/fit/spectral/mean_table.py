"""The relative sensitivity from a table of channel means by wavelength, for recordings whose frames aren't at hand.

One row a light and channel, CSV with a header. Columns: `kind` (dark, narrowband), `exposure_s`, `mean_dn`,
`mean_std_dn` (of the mean: noise, and scatter of repeats); of narrowband light `wavelength_nm`, `bandwidth_nm` (full
width at half maximum) and its power by a reference: `radiance_w_per_sr_m2`, or `photodiode_a` with
`photodiode_a_per_w`; of a colour sensor `channel` (R, G, B). A line that was measured stands beside the one that was
set: its centre and width in `measured_wavelength_nm` and `measured_bandwidth_nm`, or the CSV of its spectrum, relative
to the table, in `spectrum`. It is used in the other's place, whose cells may be empty. A spectrum without another
reading of the power is a radiance.

The power's common factor is unknown or cancels: the curves are relative to their highest value. The method is that of
frames (`lab.fit.spectral`).

Light of a triangle's width b leaves little structure of the curves finer than b in the signals. Where they hold more
than curves with usual flanks leave, the light was narrower than stated. Widths are compared by the marginal likelihood
of the signals of all channels, and scatter of the signals is weighed against that at every width (`likely_widths`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.errors import InputError, NotDetermined
from lab.fit.spectral.curve_prior import (
    averaging_matrix,
    least_misfit,
    local_roughness,
    signal_covariance,
    straight_lines,
)
from lab.fit.spectral.recordings import FINE_SHARE, OUTPUT_STEP_NM
from lab.fit.spectral.sensitivity import (
    COVERAGE_FACTOR,
    MIN_SPECTRA,
    NEGATIVE_LIGHT,
    ROUGHNESS_FLOORS,
    ChannelSignals,
    Scatter,
    joint_covariance,
    scatter_evidence,
    scatter_remarks,
    solve_sensitivities,
    trapezoid_weights,
)
from lab.formats.cgats import TableRow, read_foreign_csv, remarks_on, table_rows
from lab.formats.recording_set import DataSheet
from lab.formats.recording_set.checks import OFF_NAME_NM
from lab.formats.recording_set.files import locate
from lab.formats.results import CameraFit, FitResult, Skipped, SpectralFit
from lab.formats.results.plausible import implausible_figures
from lab.formats.spectrum_csv import parse_spectrum
from lab.observables.spectra.light_readings import RADIOMETER_STD
from sim.spectrum import FloatArray, Spectrum

#: Of the stated width: halves of it first, and where these are likelier, what lies between. Wider light isn't tried,
#: since it can't be told from curves that are smoother than their prior.
HALVES = (1.0, 0.5, 0.25, 0.125)
BETWEEN = tuple(0.5**0.5 * factor for factor in HALVES)
#: ln of the likelihood ratio of the likeliest width to the stated one from which on that isn't used: odds of 1,000.
BANDWIDTH_LOG_RATIO = 6.9
LEAST_WIDTH_SHARE = 0.02  # of the probability: curves at widths below it are left out
Signals = Callable[[float], tuple[FloatArray, Mapping[str, ChannelSignals]]]

NEEDED = ("kind", "exposure_s", "mean_dn", "mean_std_dn", "wavelength_nm", "bandwidth_nm")
RADIANCE = "radiance_w_per_sr_m2"
PHOTODIODE, RESPONSIVITY = "photodiode_a", "photodiode_a_per_w"
CENTRE, WIDTH, SPECTRUM = "measured_wavelength_nm", "measured_bandwidth_nm", "spectrum"
KNOWN = (*NEEDED, RADIANCE, PHOTODIODE, RESPONSIVITY, CENTRE, WIDTH, SPECTRUM, "channel")
GRID_NM = 1.0  # on which lights and curves stand
FINE_POINTS = 10  # of a measured spectrum in a step of the grid
LINE_SHARE = 0.1  # of a measured spectrum's maximum: samples above it make the line's centre
BELOW_DARK_SIGMA = 6.0  # noise alone puts one mean in 1e9 further below the dark
CLIPPED_SHARE = 0.95  # of the range above black: a mean above it may be of a clipped plane


@dataclass(frozen=True)
class LikelyWidths:
    """Factors on the stated bandwidth. `share`: the probabilities of those that count; `widest`: the largest that isn't
    excluded by the odds by which the stated width is. How narrow light is below that hardly matters, and roughness of
    the curves themselves looks like narrower light.
    """

    share: Mapping[float, float]
    widest: float


def likely_widths(signals_of: Signals, scatter: Scatter, fine_share: float) -> LikelyWidths | None:
    """Find the widths of narrowband light that fit; None unless the signals contradict the stated one.

    `signals_of`: wavelengths and signals by channel with the operators of a factor on the stated width. `scatter`: what
    was found at that.
    """
    evidence_of_factor = {factor: bandwidth_evidence(*signals_of(factor), scatter, fine_share) for factor in HALVES}
    if max(evidence_of_factor.values()) - evidence_of_factor[1.0] < BANDWIDTH_LOG_RATIO:
        return None
    evidence_of_factor |= {factor: bandwidth_evidence(*signals_of(factor), scatter, fine_share) for factor in BETWEEN}
    highest = max(evidence_of_factor.values())
    kept = {
        factor: float(np.exp(log - highest))
        for factor, log in evidence_of_factor.items()
        if log > highest + np.log(LEAST_WIDTH_SHARE)
    }
    widest = max(factor for factor, log in evidence_of_factor.items() if log > highest - BANDWIDTH_LOG_RATIO)
    return LikelyWidths({factor: share / sum(kept.values()) for factor, share in kept.items()}, widest)


def bandwidth_evidence(
    wave: FloatArray, signals: Mapping[str, ChannelSignals], scatter: Scatter, fine_share: float
) -> float:
    """Return ln of the marginal likelihood of `signals` under their lights, up to what all lights share.

    The local scale of the curvature prior is that of the signals over the light's power, which doesn't depend on the
    width.
    """
    average, line = averaging_matrix(wave), straight_lines(wave)
    priors, start = [], []
    for of_channel in signals.values():
        level = of_channel.operator.sum(axis=1)
        middle = of_channel.operator @ wave / level
        order = np.argsort(middle)
        local = local_roughness(wave, np.interp(wave, middle[order], (of_channel.value / level)[order]), average)
        local = np.zeros_like(wave) if local is None else local
        std = of_channel.with_scatter(scatter).std
        tried = []
        for floor in ROUGHNESS_FLOORS[1::2]:
            for fine in (0.0, fine_share):  # curves without fine structure aren't evidence for light that would hide it
                prior = signal_covariance(wave, of_channel.operator, floor + local, fine)
                tried.append((*least_misfit(prior, of_channel.operator @ line, of_channel.value, std), prior))
        _, strength, prior = min(tried, key=lambda t: t[0])
        priors.append(prior)
        start.append(2.0 * np.log(strength))
    return scatter_evidence(wave, list(signals.values()), priors, np.array(start), scatter).log_evidence


@dataclass(frozen=True)
class _TableLight:
    """One row of the table: narrowband light of a relative `power`, and a channel's mean in it, `rate` +- `rate_std`
    (DN/s above dark).

    `spectrum`: the light's power per nm, up to a factor, where it was measured; None: a line of `bandwidth_nm` at
    `wavelength_nm`.
    """

    channel: str
    wavelength_nm: float
    bandwidth_nm: float
    power: float
    rate: float
    rate_std: float
    spectrum: Spectrum | None = None


@dataclass(frozen=True)
class _MeasuredLine:
    """Centre and width of a light (nm), by its measurement where there is one, and its spectrum."""

    wavelength_nm: float
    bandwidth_nm: float
    spectrum: Spectrum | None = None


def fit_mean_table(file: Path, camera: DataSheet) -> FitResult:
    """Fit the relative sensitivities of all channels to a table of means, without frames.

    file : CSV, a row a light and channel: `kind` (dark, narrowband), `exposure_s`, `mean_dn`, `mean_std_dn`,
        `wavelength_nm`, `bandwidth_nm`, and the light's power
    camera : its `cfa`, `bit_depth` and levels

    Raises InputError with one line where a column is missing or unknown (another unit, above all) or a cell is no
    number, and `NotDetermined` where a channel has fewer than three lights. The method: `lab.fit.spectral`.
    """
    rows = table_rows(file, NEEDED, KNOWN)
    darks = [row for row in rows if row.cells["kind"] == "dark"]
    lit = [row for row in rows if row.cells["kind"] == "narrowband"]
    if len(darks) + len(lit) < len(rows):
        row = next(row for row in rows if row.cells["kind"] not in ("dark", "narrowband"))
        raise InputError(f"{file}: row {row.number}: kind '{row.cells['kind']}'; write dark or narrowband")
    if camera.black_level_dn is None and not darks:
        raise InputError(f"{file}: no row of kind dark; add the channels' means in the dark, or state black_level_dn")
    lights, clipped = [], 0
    for row in lit:
        light = _light(row, darks, camera)
        clipped += light is None
        lights += [light] if light is not None else []
    remarks = [
        (
            "of a table of means: the sensitivities are relative, as nothing says which share of the light reaches a "
            "pixel and how many DN an electron makes"
        )
    ]
    if clipped:
        remarks.append(f"{clipped} means near the highest code are left out")
    if not darks:
        remarks.append(f"no means in the dark: the stated black level of {camera.black_level_dn:g} DN is taken off")
    remarks += _lines_off_their_names(lit)
    spectra = dict.fromkeys(name for row in lit if (name := row.cells.get(SPECTRUM)))
    remarks += remarks_on(file.parent, spectra)
    spectral = _fit_curves(lights, camera.channels, remarks)
    reason = "a table of channel means holds no frames"
    skipped = tuple(Skipped(step=step, reason=reason, side="left") for step in ("noise", "mtf", "psf", "geometry"))
    fit = FitResult(source=str(file), cameras={"left": CameraFit(spectral=spectral)}, skipped=skipped)
    return fit.model_copy(update={"warnings": implausible_figures(fit, {"left": camera})})


def _channel(row: TableRow, camera: DataSheet) -> str:
    """Return the channel of a row. Raises InputError where the sensor has none of that name."""
    channel = row.cells.get("channel") or ("Y" if camera.cfa == "MONO" else "")
    if channel not in camera.channels:
        raise InputError(
            f"{row.file}: row {row.number}: channel '{channel}' of a {camera.cfa} sensor; write "
            f"{', '.join(camera.channels)}"
        )
    return channel


def _line(row: TableRow) -> _MeasuredLine:
    """Return the light of a row. Raises InputError where neither what was set nor what was measured says its centre and
    width.
    """
    if name := row.cells.get(SPECTRUM):
        spectrum = _read_spectrum(row.file, name)
        wavelength_nm, value = spectrum.arrays
        high = value > LINE_SHARE * value.max()
        middle_nm = float(np.average(wavelength_nm[high], weights=value[high]))
        return _MeasuredLine(middle_nm, float(np.trapezoid(value, wavelength_nm) / value.max()), spectrum)
    centre, width = row.known(CENTRE, 1.0), row.known(WIDTH, 0.1)
    centre = row.known("wavelength_nm", 1.0) if centre is None else centre
    width = row.known("bandwidth_nm", 0.1) if width is None else width
    if centre is None or width is None:
        raise InputError(
            f"{row.file}: row {row.number}: no {'centre' if centre is None else 'width'} of the line; write "
            f"wavelength_nm and bandwidth_nm, {CENTRE} "
            f"and {WIDTH}, or a {SPECTRUM}"
        )
    return _MeasuredLine(centre, width)


def _read_spectrum(table: Path, name: str) -> Spectrum:
    """Read the spectrum in the file `name` beside the table, with light in it. Raises InputError."""
    try:
        spectrum = parse_spectrum(read_foreign_csv(locate(table.parent, name)).text)
    except InputError as error:
        raise InputError(f"{table.parent / name}: {error}") from error
    wavelength_nm, value = spectrum.arrays
    if wavelength_nm.size < 2 or np.trapezoid(value, wavelength_nm) <= 0.0:
        raise InputError(f"{table.parent / name}: no light in it; give the spectrum of the line, or leave the row out")
    if value.min() < -NEGATIVE_LIGHT * value.max():
        at = wavelength_nm[np.argmin(value)]
        raise InputError(
            f"{table.parent / name}: {value.min():.3g} at {at:g} nm, below the limit of "
            f"{-NEGATIVE_LIGHT * value.max():.3g} for noise; take "
            "the dark off"
        )
    return spectrum


def _lines_off_their_names(lit: Sequence[TableRow]) -> list[str]:
    """Remark on lights whose measured centre isn't the wavelength set, as `lab.formats.recording_set.checks` does for
    spectra.
    """
    off: dict[float, float] = {}
    for row in lit:
        line, stated_nm = _line(row), row.known("wavelength_nm")
        if stated_nm is not None and abs(line.wavelength_nm - stated_nm) > OFF_NAME_NM + 0.25 * line.bandwidth_nm:
            off[stated_nm] = line.wavelength_nm
    if not off:
        return []
    stated_nm, measured_nm = next(iter(off.items()))
    most_nm = max(abs(measured - stated) for stated, measured in off.items())
    return [
        (
            f"{len(off)} lines are centred elsewhere than they are set, by {most_nm:.1f} nm at most ({stated_nm:g} nm: "
            f"{measured_nm:.1f} nm): the measured lines are used"
        )
    ]


def _power(row: TableRow) -> float:
    """Return the power of a row's light, up to a factor. Raises InputError where it is stated twice or not at all."""
    radiance, current = row.known(RADIANCE), row.known(PHOTODIODE)
    if radiance is None and current is None and (name := row.cells.get(SPECTRUM)):
        wavelength_nm, value = _read_spectrum(row.file, name).arrays
        return float(np.trapezoid(value, wavelength_nm))
    if (radiance is None) == (current is None):
        raise InputError(
            f"{row.file}: row {row.number}: give the light's power once, as {RADIANCE} or as {PHOTODIODE} with "
            f"{RESPONSIVITY}, or a {SPECTRUM}"
        )
    if radiance is not None:
        return radiance
    responsivity = row.known(RESPONSIVITY)
    if not responsivity:
        raise InputError(
            f"{row.file}: row {row.number}: {PHOTODIODE} without {RESPONSIVITY}; give the photodiode's responsivity "
            "at this wavelength"
        )
    return (current or 0.0) / responsivity


def _light(row: TableRow, darks: Sequence[TableRow], camera: DataSheet) -> _TableLight | None:
    """Return the light of a row with its rate; None where its mean may be clipped."""
    channel, power = _channel(row, camera), _power(row)
    exposure_s, mean, mean_std = (
        row.value("exposure_s", 1e-9),
        row.value("mean_dn", -np.inf),
        row.value("mean_std_dn", 1e-9),
    )
    if power <= 0.0:
        raise InputError(f"{row.file}: row {row.number}: no light; leave the row out, or write kind dark")
    channel_darks = [dark for dark in darks if _channel(dark, camera) == channel]
    if darks and not channel_darks:
        raise InputError(f"{row.file}: channel {channel} has no row of kind dark; add its mean in the dark")
    black, black_std = camera.black_level_dn or 0.0, 0.0
    if channel_darks:
        nearest = min(channel_darks, key=lambda dark: abs(dark.value("exposure_s") - exposure_s))
        black, black_std = nearest.value("mean_dn", -np.inf), nearest.value("mean_std_dn")
    if mean < black - BELOW_DARK_SIGMA * np.hypot(mean_std, black_std):
        raise InputError(
            f"{row.file}: row {row.number}: mean_dn {mean:g} is more than {BELOW_DARK_SIGMA:g} standard deviations "
            f"below the dark, {black:g} DN; give means and darks with the same offset"
        )
    if mean > black + CLIPPED_SHARE * (camera.saturation_dn - black):
        return None
    line = _line(row)
    return _TableLight(
        channel,
        line.wavelength_nm,
        line.bandwidth_nm,
        power,
        (mean - black) / exposure_s,
        float(np.hypot(mean_std, black_std)) / exposure_s,
        line.spectrum,
    )


def _fit_curves(lights: Sequence[_TableLight], channels: Sequence[str], remarks: list[str]) -> SpectralFit:
    """Fit the curves of `channels` to the lights; `remarks` gets what is to be reported. Raises `NotDetermined`."""
    by_channel = {c: [light for light in lights if light.channel == c] for c in channels}
    for channel, channel_lights in by_channel.items():
        if len({light.wavelength_nm for light in channel_lights}) < MIN_SPECTRA:
            raise NotDetermined(
                "spectral", f"channel {channel} has fewer than {MIN_SPECTRA} lights; add means at other wavelengths"
            )
    centres = [light.wavelength_nm for light in lights]
    out = (
        np.arange(np.ceil(min(centres) / OUTPUT_STEP_NM), np.floor(max(centres) / OUTPUT_STEP_NM) + 1) * OUTPUT_STEP_NM
    )
    if out.size < 2:
        raise NotDetermined(
            "spectral", f"the lights within {min(centres):g}..{max(centres):g} nm don't span the spectrum"
        )

    def signals_of(factor: float) -> tuple[FloatArray, dict[str, ChannelSignals]]:
        return _signals(by_channel, factor)

    def solve_with_width(factor: float) -> tuple[FloatArray, FloatArray, Scatter]:
        wave, signals = signals_of(factor)
        solved, scatter = solve_sensitivities(wave, signals, FINE_SHARE)
        at = np.stack([np.interp(out, wave, row) for row in np.eye(wave.size)], axis=1)
        curves = np.concatenate([at @ sensitivity.sensitivity for sensitivity in solved.values()])
        return curves, joint_covariance(at, solved), scatter

    value, joint, scatter = solve_with_width(1.0)
    is_stated = all(light.spectrum is None for light in lights)  # measured spectra are used as they are
    widths = likely_widths(signals_of, scatter, FINE_SHARE) if is_stated else None
    if widths is not None:
        stated = float(np.median([light.bandwidth_nm for light in lights]))
        remarks.append(
            f"the stated bandwidth of {stated:g} nm contradicts the means, by odds above "
            f"{round(np.exp(BANDWIDTH_LOG_RATIO), -2):.0f}: light "
            f"of at most {widths.widest * stated:.1f} nm fits, and the sensitivities are fitted with it; measure the "
            "width of a line"
        )
        parts = [(share, *solve_with_width(factor)) for factor, share in widths.share.items()]
        value = np.sum([share * curves for share, curves, *_ in parts], axis=0)
        joint = np.sum([share * (within + np.outer(c - value, c - value)) for share, c, within, _ in parts], axis=0)
        scatter = max(parts, key=lambda part: part[0])[3]
    remarks += scatter_remarks(scatter)
    peak = int(np.argmax(value))
    ratio = value / value[peak]
    variance = np.diag(joint) - 2.0 * ratio * joint[peak] + ratio**2 * joint[peak, peak]
    relative = np.sqrt(np.clip(variance, 0.0, None)) / value[peak]
    size = out.size

    def split_by_channel(array: FloatArray) -> dict[str, tuple[float, ...]]:
        return {c: tuple(array[k * size : (k + 1) * size].tolist()) for k, c in enumerate(channels)}

    return SpectralFit(
        wavelength_nm=tuple(out.tolist()),
        quantum_efficiency={},
        quantum_efficiency_std={},
        relative_sensitivity=split_by_channel(ratio),
        relative_sensitivity_std=split_by_channel(relative),
        coverage_factor=COVERAGE_FACTOR,
        remarks=tuple(remarks),
    )


def _count_photons(light: _TableLight, spectrum: Spectrum, wave: FloatArray) -> FloatArray:
    """Return the photons per nm, up to a factor, of a light whose spectrum was measured, averaged over the steps of the
    grid.
    """
    inner = GRID_NM * ((np.arange(FINE_POINTS) + 0.5) / FINE_POINTS - 0.5)
    shape = np.interp(wave[:, None] + inner, *spectrum.arrays, left=0.0, right=0.0).mean(axis=1)
    return np.asarray(shape * wave * light.power / np.trapezoid(spectrum.arrays[1], spectrum.arrays[0]))


def _signals(
    by_channel: Mapping[str, Sequence[_TableLight]], factor: float
) -> tuple[FloatArray, dict[str, ChannelSignals]]:
    """Return the wavelengths (m,), and the signals of each channel in lights of `factor` times the stated bandwidth;
    photons and rates are relative.
    """
    lights = [light for channel_lights in by_channel.values() for light in channel_lights]
    low = min(light.wavelength_nm - factor * light.bandwidth_nm for light in lights)
    high = max(light.wavelength_nm + factor * light.bandwidth_nm for light in lights)
    wave = np.arange(np.floor(low), np.ceil(high) + GRID_NM, GRID_NM)
    photons = float(np.median([light.power * light.wavelength_nm for light in lights]))
    highest = max(abs(light.rate) for light in lights) or 1.0
    signals_of_channel = {}
    for channel, channel_lights in by_channel.items():
        value = np.array([light.rate for light in channel_lights]) / highest
        noise = np.array([light.rate_std for light in channel_lights]) / highest
        signals_of_channel[channel] = ChannelSignals(
            np.array([_photons(light, wave, factor) for light in channel_lights]) / photons * trapezoid_weights(wave),
            value,
            np.hypot(noise, RADIOMETER_STD * value),
            tuple(f"{light.wavelength_nm} nm, {light.power}" for light in channel_lights),
            np.zeros((0, wave.size)),
            np.zeros(0),
        )
    return wave, signals_of_channel


def _photons(light: _TableLight, wave: FloatArray, factor: float) -> FloatArray:
    """Return the photons per nm, up to a factor: a triangle of `factor` times the light's bandwidth, as a monochromator
    with equal slits has, or as it was measured.
    """
    if light.spectrum is not None:
        return _count_photons(light, light.spectrum, wave)
    shape = np.clip(1.0 - np.abs(wave - light.wavelength_nm) / (factor * light.bandwidth_nm), 0.0, None)
    area = float(np.sum(shape * trapezoid_weights(wave)))
    if area <= 0.0:  # narrower than the grid, and between its points
        shape = np.clip(1.0 - np.abs(wave - light.wavelength_nm) / GRID_NM, 0.0, None)
        area = float(np.sum(shape * trapezoid_weights(wave)))
    return np.asarray(shape * light.power * light.wavelength_nm / area)
