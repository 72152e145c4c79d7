"""Blur kernels (point-spread functions) from a Bernoulli pattern on a screen.

Model: blurred = kernel * sharp + noise, kernel >= 0, sum 1 (`estimate_kernel`).

- `kernel`: the estimator: normal equations, prior, optimum under the constraints, covariance, and the registration of
  a target that was drawn a little off its place;
- `lab.observables.screens.registration`: captures of one pose, levelled between black and white, and where the pattern
  lies in the frame, from the checkerboard;
- `screen_kernel`: the pattern drawn on samples of half a pixel; registration and kernel in turn, for each channel on
  its own pixels of the mosaic, and over the field; the kernel that this finds for a given transfer function;
- `recordings`: the step on a recording set, with a test of radial symmetry;
- `photograph`: the kernel from a single photograph.

A kernel is on the pixels of the sensor, as `sim.point.kernel` defines it: element [half + i, half + j] is the
response i px down and j px right of light spread over one pixel.
"""

from lab.fit.psf.kernel import estimate_kernel

__all__ = ["estimate_kernel"]
