"""A light source in a station: its levels in plans, captures and records, and dark whenever a run stops."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import InstrumentError
from drivers.light_source.base import LightSource
from lab.capture.devices import LampDevice
from lab.capture.plan import CapturePlan, full_plan
from lab.capture.safe_at_start import Rescue
from lab.capture.session import CaptureSession
from lab.capture.station import Drivers, Station, drivers_of
from lab.capture.store import Store
from lab.capture_kinds.chart import ChartSequence
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatCapture, FlatSequence
from lab.capture_kinds.slanted_edge import EdgeSequence
from lab.errors import DeviceError, InputError
from lab.formats.recording_set import inspect
from tests.lab.fake_bench import Bench, _Fake, station

LIGHTS = {
    "3000 K": {"colour_temperature_k": 3000, "channels": {"blue": 0.2, "red": 0.8}},
    "6500 K": {"colour_temperature_k": 6500, "channels": {"blue": 0.7, "red": 0.3}},
    "460 nm": {"wavelength_nm": 460, "channels": {"blue": 1.0}},
}
WITH_LAMP = {"light_source": {"driver": "fake", "address": "lamp", "lights": LIGHTS}}
FLAT = FlatSequence(levels=(0.2, 0.4), frames=2, lamp_level=0.5, colour_temperature_k=3000)


class FakeLamp(_Fake, LightSource):
    """Two channels in steps of 1 %."""

    who = "light_source"

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench)
        self.shares = {"blue": 0.0, "red": 0.0, "green": 0.0}

    def channels(self) -> tuple[str, ...]:
        return tuple(self.shares)

    def set_level(self, level: float, channel: str | None = None) -> None:
        self.bench.check(self.who)
        self.shares[channel or "blue"] = round(level, 2)
        self.bench.log.append(f"{channel} {self.shares[channel or 'blue']:g}")

    def level(self, channel: str | None = None) -> float:
        self.bench.check(self.who)
        return self.shares[channel or "blue"]

    def stop(self) -> None:
        super().stop()
        self.shares = dict.fromkeys(self.shares, 0.0)


class LampBench(Bench):
    """The fake bench with the lamp's light in place of the monochromator's while its shutter is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.lamp = FakeLamp(self)

    @property
    def light(self) -> float:
        lit = 0.0 if self.target in ("cap", "screen") else 0.5 * sum(self.lamp.shares.values())
        return super().light + lit

    def with_lamp(self, asked: Station) -> Drivers:
        return replace(self.drivers(), light_source=self.lamp)


def started(store: Store, plan: CapturePlan, bench: LampBench) -> CaptureSession:
    return CaptureSession.start(store, station(**WITH_LAMP), plan, connect=bench.with_lamp)


def test_captures_state_what_the_lamp_said_and_it_is_dark_for_all_others(tmp_path: Path) -> None:
    store, bench = Store(tmp_path / "data"), LampBench()
    dark = DarkSequence(exposures_s=(0.01,), frames=1)
    plan = CapturePlan((FLAT, dark, FlatSequence(levels=(0.3,), frames=1), ChartSequence(frames=1, lamp_level=1.0)))
    session = started(store, plan, bench)
    assert session.run().state == "finished"
    recordings = store.recording_set(session.id)
    assert inspect(recordings)[0] == []
    stated = {(one.kind, str(one.lamp_levels), one.colour_temperature_k) for one in recordings.captures()}
    assert stated == {
        ("flat", "{'blue': 0.1, 'red': 0.4}", 3000.0),
        ("dark", "None", None),
        ("flat", "None", None),
        ("chart", "{'blue': 0.2, 'red': 0.8}", None),  # the first light of the station
    }
    assert bench.lamp.shares == dict.fromkeys(bench.lamp.shares, 0.0)
    assert store.runs(session.id)[-1].instruments["light_source"].model == "light_source"
    store.close()


def test_the_shutter_stays_closed_in_the_lamps_light() -> None:
    flats = FLAT.steps(station(**WITH_LAMP))
    assert {step.setting.wavelength_nm for step in flats} == {None}
    assert {tuple(step.setting.lamp.items()) for step in flats} == {(("blue", 0.1), ("red", 0.4))}
    edges = EdgeSequence(frames=1, lamp_level=1.0, wavelength_nm=460.0).steps(station(**WITH_LAMP))
    assert {tuple(step.setting.lamp.items()) for step in edges} == {(("blue", 1.0),)}


def test_dark_frames_after_flats_in_the_lamps_light_are_dark() -> None:
    steps = FLAT.model_copy(update={"darks_after": 3}).steps(station(**WITH_LAMP))
    after = [step for step in steps if any(one.kind == "dark" for one in step.captures)]
    assert len(after) == 3
    assert {(step.setting.wavelength_nm, *step.setting.lamp) for step in after} == {(None,)}
    flats = [one for step in steps for one in step.captures if isinstance(one, FlatCapture)]
    assert {one.colour_temperature_k for one in flats} == {3000.0}


def test_every_step_has_an_id_of_its_own_in_several_lights() -> None:
    lights = [FLAT, FLAT.model_copy(update={"colour_temperature_k": 6500.0}), FLAT.model_copy(update={"lamp_level": 1})]
    plan = CapturePlan((*lights, FlatSequence(levels=(0.2, 0.4), frames=2)))
    assert len(plan.steps(station(**WITH_LAMP))) == 4 * (1 + 2 * (1 + 2))


def test_a_station_without_a_monochromator_takes_its_flats_in_the_lamps_light() -> None:
    without = station(monochromator=None, **WITH_LAMP)
    flat = next(one for one in full_plan(without).sequences if one.name == "flat")
    assert isinstance(flat, FlatSequence) and flat.lamp_level == 1.0
    assert "flat" not in full_plan(station(monochromator=None)).names


def test_a_lamp_that_somebody_switches_off_ends_the_run_in_one_line(tmp_path: Path) -> None:
    store, bench = Store(tmp_path / "data"), LampBench()
    session = started(store, CapturePlan((FLAT,)), bench)

    def switch_off(progress: object) -> None:
        if session._done == 3:
            bench.lamp.shares["red"] = 0.0

    session._on_progress = switch_off
    with pytest.raises(
        DeviceError, match=r"channel red was set to 0.4 and is at 0 now; look who switches it"
    ) as failed:
        session.run()
    assert "\n" not in str(failed.value)
    kept = store.recording_set(session.id).captures()
    assert [one.lamp_levels for one in kept] == 2 * [{"blue": 0.1, "red": 0.4}]  # one step of two cameras, from before
    assert bench.lamp.shares == dict.fromkeys(bench.lamp.shares, 0.0)
    store.close()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"colour_temperature_k": 5000.0}, "no light of colour_temperature_k = 5000; it has 3000"),
        ({"colour_temperature_k": None, "wavelength_nm": 500.0}, "no light of wavelength_nm = 500; it has 460"),
    ],
)
def test_a_light_that_the_station_has_not_is_refused(changed: dict[str, float | None], said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        FLAT.model_copy(update=changed).steps(station(**WITH_LAMP))
    assert "\n" not in str(refused.value)


def test_a_station_without_a_light_source_says_which_table_it_needs() -> None:
    with pytest.raises(InputError, match=r"needs a light_source; add \[light_source\]"):
        FLAT.steps(station())


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"lamp_level": 50.0}, "flat.lamp_level: .*above the upper limit 1"),  # in percent
        ({"lamp_level": -0.1}, "flat.lamp_level"),
        ({"colour_temperature_k": 3000.0}, "3000 K with lamp_level = 0, at which the light source is dark"),
        ({"lamp_level": 1.0, "colour_temperature_k": 3.0}, "flat.colour_temperature_k"),  # in thousands of kelvin
    ],
)
def test_levels_beyond_the_bounds_are_refused_in_one_line(values: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said) as refused:
        full_plan(station(**WITH_LAMP), parameters={"flat": values})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("light", "said"),
    [
        ({"channels": {"blue": 40}}, "blue = 40 is outside 0..1"),
        ({"channels": {}}, "channels"),
        ({"channels": {"blue": 1.0}, "colour_temperature_k": 3000, "wavelength_nm": 460}, "exclude one another"),
    ],
)
def test_a_light_of_the_station_file_that_cannot_be_is_refused(light: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        station(light_source={"driver": "fake", "address": "lamp", "lights": {"mine": light}})


def test_a_channel_that_the_lamp_has_not_is_refused_before_anything_is_lit(tmp_path: Path) -> None:
    store, bench = Store(tmp_path / "data"), LampBench()
    lights = {"mine": {"channels": {"violet": 1.0}}}
    plan = CapturePlan((FlatSequence(levels=(0.2,), frames=1, lamp_level=1.0),))
    asked = station(light_source={"driver": "fake", "address": "lamp", "lights": lights})
    session = CaptureSession.start(store, asked, plan, connect=bench.with_lamp)
    with pytest.raises(DeviceError, match=r"no channel 'violet'; it has blue, red, green.*the sequence flat needs it"):
        session.run()
    assert bench.shots == 0
    store.close()


def test_a_level_below_half_a_step_is_told() -> None:
    lamp = LampDevice(FakeLamp(Bench()))
    status = lamp.set({"blue": 0.004})
    error = status.exception(30.0)
    assert isinstance(error, InstrumentError)
    assert "channel blue was set to 0.004 and says that it is dark" in str(error)


def test_what_is_no_longer_wanted_goes_dark_first() -> None:
    bench = Bench()
    lamp = LampDevice(FakeLamp(bench))
    assert lamp.set({"blue": 0.5}).exception(30.0) is None
    bench.log.clear()
    assert lamp.set({"green": 0.3, "red": 0.1}).exception(30.0) is None
    assert bench.log == ["blue 0", "green 0.3", "red 0.1"]
    assert lamp.readings() == {"lamp_levels": "green=0.3, red=0.1"}


def test_a_halted_lamp_is_lit_no_more() -> None:
    """A halt comes while another thread is between two channels: the second is refused, the first goes dark."""
    bench, at, go = Bench(), threading.Event(), threading.Event()

    class Slow(FakeLamp):
        def set_level(self, level: float, channel: str | None = None) -> None:
            super().set_level(level, channel)
            at.set()
            assert go.wait(30.0)

    source = Slow(bench)
    lamp = LampDevice(source)
    status = lamp.set({"blue": 0.5, "red": 0.5})
    assert at.wait(30.0)
    halting = threading.Thread(target=lamp.bar)
    halting.start()
    while "stop light_source" not in bench.log[2:]:  # the first stop is the setting's own
        threading.Event().wait(0.001)
    go.set()
    halting.join(30.0)
    assert "it stays dark" in str(status.exception(30.0))
    assert source.shares == dict.fromkeys(source.shares, 0.0)


def test_the_driver_gets_its_own_keys_alone() -> None:
    made = station(
        light_source={"driver": "pe4000", "address": "/dev/none", "load_timeout_s": 3.0, "lights": LIGHTS},
        **dict.fromkeys(("monochromator", "spectroradiometer", "display", "stage")),
        cameras={"left": station().cameras["left"].model_dump() | {"driver": "u3v", "address": "usb://1"}},
    )
    found = drivers_of(made).light_source
    assert found is not None and getattr(found, "load_timeout_s", None) == 3.0
    assert "light_source" in made.devices and "/dev/none" in made.addresses


def test_a_capture_in_the_lamps_light_is_as_hashable_as_any_other(tmp_path: Path) -> None:
    store, bench = Store(tmp_path / "data"), LampBench()
    session = started(store, CapturePlan((FLAT,)), bench)
    session.run()
    captures = store.recording_set(session.id).captures()
    assert len(set(captures)) == len(captures) == len({hash(one) for one in captures})
    assert hash(captures[0]) == hash(captures[0].model_copy())
    store.close()


def test_a_lamp_that_a_crash_left_lit_goes_dark_at_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, bench = Store(tmp_path / "data"), LampBench()
    session = started(store, CapturePlan((FLAT,)), bench)
    store.set_state(session.id, "running")  # and its process is gone
    bench.lamp.shares["red"] = 0.4
    by_address = {**bench.drivers().all, **bench.drivers().cameras, "lamp": bench.lamp}

    def driver(family: str, name: str) -> Callable[..., Any]:
        return lambda address, **settings: by_address[address] if not settings else None

    monkeypatch.setattr("lab.capture.safe_at_start.driver", driver)
    rescue = Rescue(store.root)
    rescue.stop_others(30.0)
    safe = rescue.wait_until_safe(30.0)
    assert list(safe) == [session.id]  # the lights of the station file are no setting of the driver
    assert bench.lamp.shares == dict.fromkeys(bench.lamp.shares, 0.0)
    for lock in safe.values():
        lock.release()
    store.close()
