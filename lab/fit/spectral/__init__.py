"""Spectral sensitivity from narrowband light: C = S L solved for S, with its uncertainty.

L holds the measured spectra of the lights, so that the bandwidth of the source is taken into account. Division of C by
the power of the light would smear it into S. The problem is ill-posed below the bandwidth.

- `curve_prior`: the second difference of S has a normal prior (Tikhonov regularisation), whose strength and floor
  maximise the marginal likelihood; S >= 0, and lower limits from saturated signals;
- `sensitivity`: the signals of the channels, what their errors have in common, how far they scatter beyond their
  stated standard deviations, and `estimate_sensitivity`;
- `maker_curves`: all channels at once with the curves of the maker as prior, where lights saturate; where the fitted
  curves differ from them;
- `recordings`: signals and lights of a recording set, and the step on it;
- `mean_table`: the same from a table of channel means, and whether its lights are as wide as stated.

Signals have the noise of the pixels and 0.3 % by the repeatability of the radiometer, independent from spectrum to
spectrum. Where they scatter by more, that is estimated and counted. What all signals share (conversion gain, PRNU of
the region) is a scale, added to the uncertainty at the end. The absolute calibration of the radiometer is taken as
exact.
"""

from lab.fit.spectral.sensitivity import estimate_sensitivity

__all__ = ["estimate_sensitivity"]
