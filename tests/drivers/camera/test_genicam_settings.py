"""Processing in the camera: what changes codes is switched off, and what stays on is refused."""

from __future__ import annotations

from collections.abc import Collection

import pytest

from drivers.camera.genicam_settings import Setting, switch_processing_off
from drivers.errors import InstrumentError


class _Features:
    """A camera's features in a table; those in `fixed` can't be written."""

    def __init__(self, values: dict[str, Setting], fixed: Collection[str] = ()) -> None:
        self.values, self.fixed = values, fixed

    def has(self, name: str) -> bool:
        return name in self.values

    def get(self, name: str) -> Setting:
        return self.values[name]

    def set(self, name: str, value: Setting) -> None:
        if name in self.fixed:
            raise InstrumentError(f"{name} can't be written")
        self.values[name] = value

    def entries(self, name: str) -> Collection[str]:
        return "Off", "Once", "Continuous"


def test_a_gamma_without_a_switch_is_set_to_1() -> None:
    features = _Features({"Gamma": 0.45, "BslContrast": 0.2, "ExposureAuto": "Continuous"})
    switch_processing_off(features, "camera 1")
    assert features.values == {"Gamma": 1.0, "BslContrast": 0.0, "ExposureAuto": "Off"}


def test_a_gamma_whose_switch_is_off_may_stand_as_it_is() -> None:
    features = _Features({"GammaEnable": True, "Gamma": 0.45}, fixed=["Gamma"])
    switch_processing_off(features, "camera 1")
    assert features.values == {"GammaEnable": False, "Gamma": 0.45}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"Gamma": 0.45},
            r"camera 1: Gamma is 0\.45 and can't be set to 1\.0: its codes aren't the converter's; switch",
        ),
        ({"GainAuto": "Continuous"}, "GainAuto is Continuous and can't be set to Off"),
    ],
)
def test_what_stays_on_is_refused_in_one_line(values: dict[str, Setting], message: str) -> None:
    with pytest.raises(InstrumentError, match=message) as caught:
        switch_processing_off(_Features(dict(values), fixed=list(values)), "camera 1")
    assert "\n" not in str(caught.value)
