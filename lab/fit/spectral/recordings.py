"""The quantum efficiency of a camera from its narrowband captures, as it stands in the results."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.fit.spectral.captures import SpectralCaptures
from lab.fit.spectral.channel_signals import ChannelSignals, joint_covariance
from lab.fit.spectral.maker_departures import compare_curves
from lab.fit.spectral.maker_prior import solved_with_maker
from lab.fit.spectral.scatter import scatter_remarks
from lab.fit.spectral.sensitivity import COVERAGE_FACTOR, Sensitivity, solved_sensitivities, trapezoid_weights
from lab.formats.recording_set import RecordingSet
from lab.formats.results import MakerDeparture, NoiseFit, SpectralFit
from lab.one_blas_thread import one_blas_thread
from sim.camera import Side
from sim.spectrum import FloatArray

# A curve is stated every 10 nm, mostly at the wavelengths of the lights, where structure finer than these is largest.
FINE_SHARE = 0.13  # chosen so that bands contain measured curves at the stated wavelengths
OUTPUT_STEP_NM = 10.0
SEEN_SIGMA = 5.0  # standard deviations that one signal at least has to be above the dark
CENTROID_MARGIN_NM = 1.0  # beyond the centroids of the outer lights up to which the curve is stated


@one_blas_thread
def fit_spectral(recordings: RecordingSet, side: Side, noise: NoiseFit | None = None) -> SpectralFit:
    """Absolute quantum efficiency of every channel from the narrowband captures, electrons per photon at the pixel.

    Irradiance on axis: pi T L / (1 + 4 N^2). The stated transmittance of the lens T and the fill factor are divided
    out, and the mean cos^4 of the region. Signals are means over the central quarter of rows and columns. Saturated
    captures are left out. Where a channel has no other light, the curves of the maker (times a smooth factor common to
    the channels, and a smooth factor of a few per cent of each) and the flats with a stated radiance stand in; without
    these, smoothness alone. Raises `NotDetermined` where the scale or the light is missing. The method:
    `lab.fit.spectral`.
    """
    captures = SpectralCaptures(recordings, side, noise)
    signals = captures.signals()
    gaps = {c: s.limit.size for c, s in signals.items() if s.has_gaps}
    maker = captures.maker_curves() if gaps else None
    if gaps:
        listed = ", ".join(f"{channel} under {count}" for channel, count in gaps.items())
        filled = (
            "there the curve rests on the maker's, times a smooth factor that the channels share, and on the flats"
            if maker
            else "there the curve is known from below and by its smoothness alone"
        )
        captures.remarks.append(
            f"saturated narrowband captures are left out ({listed} lights): {filled}; expose shorter to measure it"
        )
    if maker:
        signals = captures.with_flats(signals)
        solved = dict(
            zip(
                signals,
                solved_with_maker(captures.wave, list(signals.values()), [maker[c] for c in signals]),
                strict=True,
            )
        )
    else:
        solved, scatter = solved_sensitivities(captures.wave, signals, FINE_SHARE)
        captures.remarks += scatter_remarks(scatter)
    return _result(captures, solved, signals, maker_is_prior=bool(maker))


def _span(captures: SpectralCaptures) -> tuple[float, float]:
    """First and last wavelength that the lights determine: narrowband by the centroids of their measured spectra
    (their nominal ones may be some nm off), broadband wholly.
    """
    if any(isinstance(capture, FlatCapture) for capture in captures.narrowband):
        return float(captures.wave[0]), float(captures.wave[-1])
    paths = {captures.path(capture) for capture in captures.narrowband}
    centroids = []
    for rate in (captures.photon_rate(path) for path in paths):
        if rate.max() > 0:
            centroids.append(float(np.sum(rate * captures.wave) / rate.sum()))
    margin = CENTROID_MARGIN_NM
    return max(min(centroids) - margin, captures.wave[0]), min(max(centroids) + margin, captures.wave[-1])


def _result(
    captures: SpectralCaptures,
    solved: dict[str, Sensitivity],
    signals: dict[str, ChannelSignals],
    *,
    maker_is_prior: bool,
) -> SpectralFit:
    """The curves every 10 nm, with their standard deviations, where they are determined, and beside those of the
    maker.
    """
    low, high = _span(captures)
    out = np.arange(np.ceil(low / OUTPUT_STEP_NM), np.floor(high / OUTPUT_STEP_NM) + 1) * OUTPUT_STEP_NM
    known = {c: np.interp(out, captures.wave, found.determined.astype(float)) > 0.5 for c, found in solved.items()}
    any_channel = np.flatnonzero(np.any(list(known.values()), axis=0))
    inside = slice(any_channel[0], any_channel[-1] + 1) if any_channel.size else slice(0, 0)
    out = out[inside]
    highest = max(float(np.max(own.value / own.std)) for own in signals.values())
    if highest < SEEN_SIGMA and not any(own.has_gaps for own in signals.values()):
        raise NotDetermined(
            "spectral",
            f"the captures show no light: the strongest signal is {highest:.1f} standard uncertainties above the dark, {SEEN_SIGMA:g} "
            "needed: open the shutter, or expose longer",
        )
    if out.size < 2:
        raise NotDetermined(
            "spectral",
            f"the lights within {low:.0f}..{high:.0f} nm don't span the spectrum: capture narrowband light over the visible by "
            "10 nm or finer",
        )
    gaps = {c: _intervals(out, ~k[inside]) for c, k in known.items()}
    for channel, runs in gaps.items():
        if runs:
            where = ", ".join(f"{a:g}..{b:g} nm" for a, b in runs)
            captures.remarks.append(
                f"{channel} isn't identifiable at {where}: no light that was measured tells it there; capture narrowband light there"
            )
    channels = list(solved)
    at = np.stack([np.interp(out, captures.wave, row) for row in np.eye(captures.wave.size)], axis=1)
    joint = joint_covariance(at, solved)
    value = np.concatenate([np.interp(out, captures.wave, solved[c].sensitivity) for c in channels])
    # PRNU of the region differs between channels; the conversion gain is common
    prnu = (captures.noise.prnu_percent if captures.noise is not None else None) or 0.0
    for k, channel in enumerate(channels):
        own = slice(k * out.size, (k + 1) * out.size)
        joint[own, own] += (prnu / 100.0) ** 2 / captures.pixels[channel] * np.outer(value[own], value[own])
    absolute = np.sqrt(np.diag(joint) + (captures.gain_std / captures.gain * value) ** 2)
    peak = int(np.argmax(value))
    ratio = value / value[peak]
    variance_of_ratio = np.diag(joint) - 2.0 * ratio * joint[peak] + ratio**2 * joint[peak, peak]
    relative = np.sqrt(np.clip(variance_of_ratio, 0.0, None)) / value[peak]

    def by_channel(array: FloatArray) -> dict[str, tuple[float, ...]]:
        return {c: tuple(row.tolist()) for c, row in zip(channels, array.reshape(len(channels), -1), strict=True)}

    integral, integral_std = _integrals(out, value, joint, captures.gain_std / captures.gain)
    scale, departures = _departures(captures, out, channels, value, joint) if not maker_is_prior else (None, ())
    return SpectralFit(
        wavelength_nm=tuple(out.tolist()),
        quantum_efficiency=by_channel(value),
        quantum_efficiency_std=by_channel(absolute),
        relative_sensitivity=by_channel(ratio),
        relative_sensitivity_std=by_channel(relative),
        integrated_efficiency_nm=dict(zip(channels, integral, strict=True)),
        integrated_efficiency_nm_std=dict(zip(channels, integral_std, strict=True)),
        not_determined_nm={c: runs for c, runs in gaps.items() if runs},
        maker_scale=scale,
        maker_departures=departures,
        coverage_factor=COVERAGE_FACTOR,
        remarks=tuple(captures.remarks),
    )


def _integrals(
    out: FloatArray, value: FloatArray, joint: FloatArray, gain_error: float
) -> tuple[list[float], list[float]]:
    """Integrals over wavelength of the curves `value` (channels x k,) at `out` (k,), nm, and their standard deviations, by channel.

    `joint`: covariance of `value` without the relative error of the gain, `gain_error`.
    """
    weights = np.kron(np.eye(value.size // out.size), trapezoid_weights(out))
    total = weights @ value
    std = np.sqrt(np.diag(weights @ joint @ weights.T) + (gain_error * total) ** 2)
    return total.tolist(), std.tolist()


def _departures(
    captures: SpectralCaptures, out: FloatArray, channels: Sequence[str], value: FloatArray, joint: FloatArray
) -> tuple[float | None, tuple[MakerDeparture, ...]]:
    """The fitted curves beside those of the maker; None where there are none."""
    maker = captures.maker_curves()
    if maker is None:
        return None, ()
    ends = [
        captures.recordings.spectrum((captures.camera.quantum_efficiency or {})[c]).arrays[0][[0, -1]] for c in channels
    ]
    covered = (out >= max(low for low, _ in ends)) & (out <= min(high for _, high in ends))
    if not covered.any():
        return None, ()
    every = np.tile(covered, len(channels))
    stated = np.concatenate([np.interp(out[covered], captures.wave, maker[c]) for c in channels])
    return compare_curves(out[covered], channels, value[every], joint[np.ix_(every, every)], stated)


def _intervals(wave: FloatArray, where: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """First and last wavelength of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return tuple((float(wave[a]), float(wave[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))
