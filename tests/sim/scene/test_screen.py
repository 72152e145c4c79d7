"""Screens: gamma of each primary, black and white, stripes of sub-pixels."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sim.scene import Screen, SubPixels
from sim.spectrum import Spectrum

CURVE = Spectrum.of([400.0, 700.0], [1.0, 2.0])


def screen(**changes: object) -> Screen:
    return Screen.model_validate(
        {"primaries": (CURVE, CURVE.scale(2.0), CURVE.scale(3.0)), "black_radiance": CURVE.scale(0.01)} | changes
    )


def ramp() -> np.ndarray:
    return np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)


def test_drives_follow_each_primarys_gamma() -> None:
    drives = np.squeeze(screen(gamma=(2.2, 1.8, 1.0)).drives(ramp())).T
    code = np.arange(256) / 255
    np.testing.assert_allclose(drives, np.stack([code**2.2, code**1.8, code], axis=-1), rtol=1e-14)


def test_codes_up_to_black_are_off() -> None:
    drives = np.squeeze(screen(black_code=(0.1, 0.0, 0.2)).drives(ramp())).T
    assert np.all(drives[:26, 0] == 0)
    assert drives[26, 0] > 0
    assert np.all(drives[:52, 2] == 0)
    np.testing.assert_array_equal(drives[255], 1.0)
    assert np.all(np.diff(drives, axis=0) >= 0)


def test_white_is_all_primaries_and_black() -> None:
    np.testing.assert_allclose(screen().white_radiance.value, np.array(CURVE.value) * 6.01, rtol=1e-14)


def test_stripes_do_not_overlap() -> None:
    for order in ("RGB", "BGR"):
        layout = SubPixels(width=1 / 3, height=0.7, order=order)
        edges = sorted(layout.locate_stripe(channel)[:2] for channel in range(3))
        np.testing.assert_allclose(np.ravel(edges), [0, 1 / 3, 1 / 3, 2 / 3, 2 / 3, 1], atol=1e-15)
        assert (layout.locate_stripe(0)[0] < layout.locate_stripe(2)[0]) == (order == "RGB")
        assert layout.share == pytest.approx(0.7 / 3)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"gamma": (2.2, 9.0, 2.2)}, "9.0 is above the upper limit 5.0"),
        ({"black_code": (-0.1, 0.0, 0.0)}, "-0.1 is below the lower limit 0.0"),
        ({"black_radiance": CURVE.scale(-1.0)}, "black has a radiance of -2"),
        ({"falloff_exponent": -1.0}, "below the lower limit"),
        ({"sub_pixels": {"width": 0.5}}, "above the upper limit"),
    ],
)
def test_a_screen_that_cannot_be_is_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        screen(**changes)
