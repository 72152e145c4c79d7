"""A stated arrangement of the mosaic's colours that the recordings contradict: planes respond to lights as another
channel's sensitivity predicts."""

from __future__ import annotations

import numpy as np

from lab.diagnose.measurements.chart import CHART
from lab.diagnose.measurements.narrowband import NARROWBAND
from lab.diagnose.metadata.lit_planes import LitPlanes, chart_planes, narrowband_planes, predicted
from lab.diagnose.metadata.misstatement import Misstatement, restated_camera
from lab.diagnose.policy import DEFAULT_POLICY, DecisionPolicy
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import RecordingSet
from sim.camera import Cfa, Side
from sim.spectrum import FloatArray

MOSAICS: tuple[Cfa, ...] = ("RGGB", "BGGR", "GRBG", "GBRG")
# Errors are rms departures of ln(rate) from its prediction.
#: Share of a light's brightest plane that is added to all rates: low rates count little, as low sensitivities may
#: differ by any factor.
DIM = 0.05
ROUNDS = 6


def misstated_mosaic_phase(
    recordings: RecordingSet, side: Side, policy: DecisionPolicy = DEFAULT_POLICY
) -> Misstatement | None:
    """Return a stated mosaic that fits the planes' rates worse than another one; None where it fits.

    r = ln(rate of a plane) - ln(predicted rate of its channel) - level of the light - gain of the channel, over
    narrowband lights and patches of a chart. The mosaic with the least rms of r is the best. Where no sensitivity
    curves are stated, typical ones are used: wrong colours are wrong by factors.
    """
    stated = recordings.camera(side).cfa
    if stated == "MONO":
        return None
    patches = [one for light in chart_planes(recordings, side) for one in light]
    narrow = narrowband_planes(recordings, side)
    seen = [one for one in (*narrow, *patches) if np.isfinite(one.rate).sum() > 1]
    seen = [one for one in seen if np.nanmax(one.rate) > policy.mosaic_bright * one.offset]
    if len(seen) < policy.mosaic_least_lights:
        return None
    camera = camera_model(recordings, side, maker_curves=True)
    rates = predicted(recordings, camera, seen)
    errors = {cfa: _error(seen, rates, cfa, policy.mosaic_most_gain) for cfa in MOSAICS}
    best, second = sorted(MOSAICS, key=lambda cfa: errors[cfa])[:2]
    if best == stated or errors[stated] < policy.mosaic_least_error:
        return None
    if errors[best] > min(policy.mosaic_better * errors[stated], policy.mosaic_surer * errors[second]):
        return None
    n = 4 * len(seen)
    # the numbers' standard deviation is estimated by the best mosaic's error
    std = max(errors[best], policy.mosaic_least_error / 3.0)
    return Misstatement(
        measurement=NARROWBAND if narrow else CHART,
        where="all lights",
        shape="the stated mosaic contradicts the colours that its planes see",
        check=f"The planes of the {side} camera answer the lights as a mosaic {best} does (rms "
        f"{100 * errors[best]:.0f} %), but cfa = {stated} is "
        f"stated (rms {100 * errors[stated]:.0f} %): correct cfa to {best}, or crop or turn the frames by even "
        "numbers of pixels, and fit again.",
        chi2_stated=n * (errors[stated] / std) ** 2,
        chi2_corrected=n * (errors[best] / std) ** 2,
        n=n,
        captures=tuple(dict.fromkeys(name for one in seen for name in one.captures)),
        corrected=restated_camera(recordings, side, cfa=best),
    )


def _error(seen: list[LitPlanes], rates: dict[str, FloatArray], cfa: Cfa, most_gain: float) -> float:
    """Rms of r (see `misstated_mosaic_phase`) for the mosaic `cfa`; logarithms of gains are `most_gain` at most."""
    rate = np.array([one.rate for one in seen])  # NaN where clipped
    expected = np.where(np.isfinite(rate), np.array([rates[channel] for channel in cfa]).T, np.nan)
    expected = expected * (np.nansum(rate, axis=1) / np.maximum(np.nansum(expected, axis=1), 1e-300))[:, None]
    dim = np.maximum(DIM * np.nanmax(rate, axis=1), [one.offset for one in seen])[:, None]
    left = np.log(np.maximum(rate, 0.0) + dim) - np.log(expected + dim)
    channels = np.array(list(cfa))
    gain = dict.fromkeys(cfa, 0.0)
    for _ in range(ROUNDS):
        moved = left - np.array([gain[channel] for channel in cfa])
        moved = moved - np.nanmedian(moved, axis=1, keepdims=True)
        for channel in gain:
            own = moved[:, channels == channel]
            step = float(np.median(own[np.isfinite(own)])) if np.isfinite(own).any() else 0.0
            gain[channel] = float(np.clip(gain[channel] + 0.5 * step, -most_gain, most_gain))
    final = left - np.array([gain[channel] for channel in cfa])
    final = final - np.nanmean(final, axis=1, keepdims=True)
    return float(np.sqrt(np.nanmean(np.square(final))))
