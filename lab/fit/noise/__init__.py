"""Noise by photon transfer: conversion gain, read noise, black level, dark current, DSNU, PRNU, saturation, linearity.

Definitions: EMVA Standard 1288, release 4.0 (linear). The steps, one module each:

- `lab.observables.noise.side_levels`: the darks and flats of one camera by level, which the diagnosis reads, too;
  `lab.observables.noise.stack`: means, temporal and spatial variances of the repeats of one level, without defective
  pixels and the smooth shading; `lab.observables.flats.stated_light`: the light that flats state;
- `lab.observables.flats.level_lines`: dark means against exposure, which flats clip, and a response that outliers
  don't move;
- `evaluation`: which flats serve the lines, what their means scatter, and the state that all figures rest on;
- `photon_transfer`: conversion gain and curvature from variances against means;
- `dark_current` (black level, read noise, dark current), `fixed_pattern` (DSNU, PRNU, shading), `response` (linearity,
  full well, quantum efficiency, curvature of the variance);
- `emva1288`: the figures as specified in the standard, in addition to the physical fit;
- `lab.observables.darks.pixels`, `pixel_maps`: figures and maps of single pixels;
- `noise_fit`: the step on a recording set, and its results.

Where the fit departs from the letter of the standard:

- The conversion gain K is the slope of the temporal variance against the mean at zero signal, of v = v0 + K x + c x^2
  fitted to all unsaturated levels and planes at once, weighted by the uncertainty of the variances. The curvature c
  takes up a nonlinear response and brighter-fatter, which bias the straight line of the standard (to 70 % of
  saturation) by 1.5 times the curvature. Residuals beyond the sampling noise of the variances are an error of the
  model (of an uneven converter, mostly). Its part that is smooth over the whole range is invisible, since the curve
  takes it up; it is assumed to be as large as the visible part. Where the curvature isn't significant against it, K is
  the straight line of the standard, and its uncertainty spans both.
- Three measurements tell the causes of a curvature apart: the means against the light give the curvature of the
  response; curvature of the variance beyond three times that is missing noise; and the temporal covariances of
  neighbouring pixels show whether that noise went there (brighter-fatter).
- Frames are compared after their means have been subtracted plane by plane, so that a drift of the lamp between
  repeats doesn't count as temporal noise.
- PRNU is of the residual from a smooth surface (polynomial of degree 6 in rows and in columns, plane by plane): the
  cos^4 of the lens and the shading of a lamp don't count. Pixels beyond 8 standard deviations are defects: they are
  left out, counted and reported.
"""
