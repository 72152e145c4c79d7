"""Errors of a rig within its tolerances: of a chart's reflectances, and of a radiometer's readings.

The observables' covariances hold them, as priors that are declared. Where an observable is held against its covariance,
they are drawn, too.
"""

from __future__ import annotations

import numpy as np

from lab.observables.charts.patches import PATCH_COLOUR_STD, PATCH_LEVEL_STD, PATCH_STD
from lab.observables.spectra.light_readings import RADIOMETER_STD, READING_SAMPLE_STD
from sim.spectrum import FloatArray

#: Borders of the bands in which the colour of a patch is wrong independently, nm: those of blue, green and red.
BANDS_NM = (492.0, 568.0)
#: Standard deviation of a reading as a whole, over the largest that is allowed for.
READING_SHARE = 0.5


class RigErrors:
    """The errors of one rig, drawn from `seed`."""

    def __init__(self, *seed: int) -> None:
        self._chart, self._radiometer = (np.random.default_rng([*seed, part]) for part in (0, 1))

    def reflectances(self, wavelength_nm: FloatArray, published: FloatArray) -> FloatArray:
        """Return the reflectances (patches, wavelengths) of the rig's chart; `published`: those of all charts."""
        rng, patches = self._chart, len(published)
        colour = PATCH_COLOUR_STD * rng.standard_normal((patches, len(BANDS_NM) + 1))
        factor = 1.0 + PATCH_STD * rng.standard_normal((patches, 1)) + colour[:, np.digitize(wavelength_nm, BANDS_NM)]
        level = PATCH_LEVEL_STD * rng.standard_normal((patches, 1))
        return np.asarray(np.clip(factor * published + level, 0.0, 1.0))

    def reading(self, radiance: FloatArray) -> FloatArray:
        """Return what the radiometer reads of a radiance (wavelengths,): wrong as a whole, and in each sample."""
        rng = self._radiometer
        whole = READING_SHARE * RADIOMETER_STD * rng.standard_normal()
        return radiance * (1.0 + whole + READING_SAMPLE_STD * rng.standard_normal(radiance.shape))
