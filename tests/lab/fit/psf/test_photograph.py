"""The kernel of a real photograph of a pattern."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.errors import NotDetermined
from lab.fit.psf.photograph import estimate_from_photograph

PHOTO = Path(__file__).parents[5] / "shared/data/delbracio_noise_target"


@pytest.mark.slow
@pytest.mark.skipif(not PHOTO.is_dir(), reason="the photograph of Delbracio's noise target isn't there")
def test_the_kernel_of_a_real_photograph_explains_it():
    photo = cv2.imread(str(PHOTO / "img_example.pgm"), cv2.IMREAD_UNCHANGED).astype(float)
    pattern = (cv2.imread(str(PHOTO / "pattern_noise.pgm"), cv2.IMREAD_UNCHANGED) > 127).astype(np.uint8)
    found = estimate_from_photograph(photo, pattern)
    # homography and pixel box explain 93 % at best
    assert 0.90 < found.explained_by_box < 0.94
    assert found.explained >= 0.96
    assert found.kernel.sum() == pytest.approx(1)
    with pytest.raises(NotDetermined, match="doesn't show the pattern"):
        estimate_from_photograph(photo, np.random.default_rng(0).integers(0, 2, pattern.shape).astype(np.uint8))
