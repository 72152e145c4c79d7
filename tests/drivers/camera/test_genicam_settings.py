"""Processing in the camera: what changes codes is set neutral and read back; what stays on is told, or refused where
frames mean nothing then."""

from __future__ import annotations

from collections.abc import Collection

import pytest

from drivers.camera.genicam_settings import NEUTRAL, SELECTORS, Setting, make_neutral, snapshot
from drivers.errors import InstrumentError


class _Features:
    """A camera's features in a table, `Name[Entry]` where a selector chooses; those in `fixed` can't be written."""

    def __init__(self, values: dict[str, Setting], fixed: Collection[str] = ()) -> None:
        self.values, self.fixed = values, fixed

    def _key(self, name: str) -> str:
        selector = SELECTORS.get(name, "")
        return f"{name}[{self.values[selector]}]" if selector in self.values else name

    def has(self, name: str) -> bool:
        return self._key(name) in self.values

    def get(self, name: str) -> Setting:
        return self.values[self._key(name)]

    def set(self, name: str, value: Setting) -> None:
        if name in self.fixed:
            raise InstrumentError(f"{name} can't be written")
        self.values[self._key(name)] = value

    def entries(self, name: str) -> Collection[str]:
        if name in SELECTORS.values():
            return {"BalanceRatioSelector": ("Red", "Green", "Blue")}.get(name, ("AnalogAll", "DigitalAll"))
        return "Off", "Once", "Continuous", "Linear", "RGB", "General"


def test_a_gamma_without_a_switch_is_set_to_1() -> None:
    features = _Features({"Gamma": 0.45, "BslContrast": 0.2, "ExposureAuto": "Continuous"})
    assert make_neutral(features, "camera 1") == ()
    assert features.values == {"Gamma": 1.0, "BslContrast": 0.0, "ExposureAuto": "Off"}


def test_a_gamma_whose_switch_is_off_may_stand_as_it_is() -> None:
    features = _Features({"GammaEnable": True, "Gamma": 0.45}, fixed=["Gamma"])
    make_neutral(features, "camera 1")
    assert features.values == {"GammaEnable": False, "Gamma": 0.45}


def test_white_balance_is_1_in_every_channel_and_the_selector_as_it_was() -> None:
    features = _Features(
        {
            "BalanceWhiteAuto": "Continuous",
            "LightSourcePreset": "Daylight5000K",
            "BalanceRatioSelector": "Green",
            "BalanceRatio[Red]": 1.8,
            "BalanceRatio[Green]": 1.0,
            "BalanceRatio[Blue]": 2.1,
        }
    )
    assert make_neutral(features, "camera 1") == ()
    assert features.values == {
        "BalanceWhiteAuto": "Off",
        "LightSourcePreset": "Off",
        "BalanceRatioSelector": "Green",
        "BalanceRatio[Red]": 1.0,
        "BalanceRatio[Green]": 1.0,
        "BalanceRatio[Blue]": 1.0,
    }


def test_only_the_digital_gain_is_taken_to_0_db() -> None:
    features = _Features({"GainSelector": "AnalogAll", "Gain[AnalogAll]": 6.0, "Gain[DigitalAll]": 3.0})
    make_neutral(features, "camera 1")
    assert features.values == {"GainSelector": "AnalogAll", "Gain[AnalogAll]": 6.0, "Gain[DigitalAll]": 0.0}
    plain = _Features({"Gain": 6.0})
    make_neutral(plain, "camera 1")
    assert plain.values == {"Gain": 6.0}


def _away_from(neutral: Setting) -> Setting:
    if isinstance(neutral, bool):
        return not neutral
    return "Continuous" if isinstance(neutral, str) else neutral + 2


@pytest.mark.parametrize("one", NEUTRAL, ids=lambda one: one.name)
def test_every_feature_of_the_table_is_set_or_told_or_refused(one) -> None:  # type: ignore[no-untyped-def]
    if one.entries != ("",):
        pytest.skip("the gain is set by each exposure")
    away = _away_from(one.value)
    features = _Features({one.name: away})
    make_neutral(features, "camera 1")
    assert features.values == {one.name: one.value}
    stuck = _Features({one.name: away}, fixed=[one.name])
    if one.must:
        with pytest.raises(InstrumentError, match=f"{one.name} is .* and can't be set to"):
            make_neutral(stuck, "camera 1")
    else:
        assert make_neutral(stuck, "camera 1") == (f"{one.name} = {away}",)


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
def test_what_must_not_stay_on_is_refused_in_one_line(values: dict[str, Setting], message: str) -> None:
    with pytest.raises(InstrumentError, match=message) as caught:
        make_neutral(_Features(dict(values), fixed=list(values)), "camera 1")
    assert "\n" not in str(caught.value)


def test_a_snapshot_has_each_channel() -> None:
    features = _Features(
        {"Width": 640, "BalanceRatioSelector": "Red", **{f"BalanceRatio[{name}]": 1.0 for name in ("Red", "Green")}}
    )
    assert snapshot(features) == {"Width": 640, "BalanceRatio[Red]": 1.0, "BalanceRatio[Green]": 1.0}
