"""Modulation transfer function from a slanted edge on the raw mosaic (the purpose of the e-SFR of ISO 12233).

Each Bayer plane is analysed on its own grid; nothing is demosaiced.

- `edge_finding`: where the edge lies, a cubic polynomial in the frame, found by iterated least squares;
- `edge_spread`: the edge-spread function (ESF) is a cubic spline of the distance from the edge. Its knots are even
  near the edge and ever wider apart in the tails. A spline is used because a basis of hat functions leaves a ripple of
  h^2 E'' / 12, which samples at uneven distances turn into a bias of 0.1 % of MTF50. A prior of the line-spread
  function (LSF), the derivative of the ESF, decides what the samples leave open: a Gaussian, a Gaussian process about
  it, and the 1 / distance^2 tail of diffraction, which holds 1 % of the contrast beyond any region;
- `transfer_function`: the ESF is fitted by weighted least squares together with the gradient of the illumination. The
  MTF is the Fourier transform of the derivative of the spline, in closed form, with its covariance. `edge_mtf` is the
  whole estimator, on a region;
- `recordings`: edges of a frame that are usable, and the step on the captures of a recording set.

Once the edge is found, the estimate is linear in the pixel values. `EdgeGeometry` keeps this linear operator, and
`EdgeMtf.predict` sends a predicted edge profile through it. A comparison of the two is free of the bias of the
estimator.

Frequencies are in cycles per pixel of the full sensor, along the normal of the edge. This holds also for a plane that
is sampled at every second pixel: the slant samples the profile more finely than the pitch of the plane.
"""

from lab.fit.mtf.transfer_function import edge_mtf

__all__ = ["edge_mtf"]
