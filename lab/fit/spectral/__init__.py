"""Spectral sensitivity from narrowband light: C = S L solved for S, with its uncertainty.

L holds the measured spectra of the lights, so that the bandwidth of the source is taken into account. Division of C by
the power of the light would smear it into S. The problem is ill-posed below the bandwidth. The steps, one module each:

- `curvature_prior`: the second difference of S has a normal prior (Tikhonov regularisation). It is wider where the
  curve has curvature and is high: its local scale is the geometric mean of curvature and height of a first solution,
  smoothed, plus a floor;
- `tikhonov`: strength and floor of the prior maximise the marginal likelihood, with straight lines free and integrated
  out;
- `scatter`: how far signals scatter beyond their stated standard deviations, by the marginal likelihood of all channels;
- `bandwidth`: whether the lights of a table are as wide as stated, by the same likelihood;
- `bounds`: S >= 0, and lower limits from saturated signals;
- `sensitivity`: these together (`estimate_sensitivity`); `channel_signals`: what they are given, and what channels share;
- `maker_prior`: all channels at once with the curves of the maker as prior, where lights saturate; `maker_departures`:
  where the fitted curves differ from them;
- `captures`: signals and lights of a recording set; `recordings`: the step on it.

Signals have the noise of the pixels and 0.3 % by the repeatability of the radiometer, independent from spectrum to
spectrum. Where they scatter by more, that is estimated and counted. What all signals share (conversion gain, PRNU of the region) is a scale, added to the uncertainty at the end.
The absolute calibration of the radiometer is taken as exact.
"""

from lab.fit.spectral.sensitivity import estimate_sensitivity

__all__ = ["estimate_sensitivity"]
