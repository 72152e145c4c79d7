"""Blur kernels (point-spread functions) from a Bernoulli pattern on a screen.

Model: blurred = kernel * sharp + noise, kernel >= 0, sum 1 (`estimate_kernel`). The steps, one module each:

- `normal_equations`: the Gram matrix of the least squares, over the region in which the whole kernel sees the target.
  No border is used and no periodicity is assumed;
- `kernel_prior`: the prior of the kernel, a Gaussian process with covariance envelope x stationary correlation x
  envelope. Its strength and length maximise the marginal likelihood, and its envelope comes from the estimate itself;
- `simplex`: the exact optimum under kernel >= 0, sum 1. The sum belongs to the problem: positivity alone biases it
  upwards, and a normalisation afterwards does not correct that;
- `regularised_kernel`: these three together, with the covariance;
- `target_displacement`, `kernel_from_target`: `estimate_kernel`, which registers a target that was drawn a little off
  its place.

On recordings:

- `levelled_captures`: captures of one pose, levelled between black and white;
- `screen_registration`: where the pattern lies in the frame, from the checkerboard;
- `drawn_pattern`: the pattern drawn on samples of half a pixel, for on samples of a pixel the sharp borders of its
  cells cannot be placed;
- `pixel_sampling`: from those samples to the pixels of the sensor;
- `screen_kernel`: registration and kernel in turn, for each channel on its own pixels of the mosaic, and over the
  field;
- `radial_symmetry`: a test of the kernels over the field;
- `recordings`: the step on a recording set;
- `expected_kernel`: the kernel that the estimator finds for a given transfer function; `photograph`: the kernel from a
  single photograph.

A kernel is on the pixels of the sensor, as `sim.point.kernel` defines it: element [half + i, half + j] is the
response i px down and j px right of light spread over one pixel.
"""

from lab.fit.psf.kernel_from_target import estimate_kernel

__all__ = ["estimate_kernel"]
