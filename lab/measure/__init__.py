"""Summaries of captures that fits and diagnosis share; it knows neither.

- darks and flats: statistics of the levels (`levels`), lines through them (`level_lines`), the light that flats state
  (`stated_light`), single pixels in the dark (`dark_pixels`);
- slanted edges: the edges of a frame and the MTF of one (`edges`), by `edge_finding`, `edge_spread` and `edge_mtf`;
- boards: corners (`board_detection`), the camera model (`pinhole`), one solve for intrinsics, poses and warp
  (`bundle_adjustment`), and its outliers, choice of model and halves (`board_calibration`);
- screens: captures of one pose, and where the pattern lies in the frame (`screen_registration`);
- narrowband light: means by channel (`plane_means`);
- charts: levels of the patches and their covariance (`patches`);
- one side of a recording set with its noise figures, held-out captures and baseline (`study`, `noise_figures`,
  `repeatability`);
- captures that aren't what they are said to be (`mishaps`).
"""
