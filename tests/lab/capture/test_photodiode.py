"""A reference photodiode in a station: the irradiance beside the narrowband captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from drivers.errors import Refused
from drivers.photodiode.base import IrradianceMeasurement, Photodiode
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture.station import Drivers, Station
from lab.capture.store import Store
from lab.capture_kinds.dark import DarkSequence
from lab.capture_kinds.flat import FlatCapture, FlatSequence
from lab.capture_kinds.narrowband import NarrowbandCapture, NarrowbandSequence
from lab.errors import DeviceError
from lab.formats.recording_set import inspect
from tests.lab.fake_bench import Bench, _Fake, station

PLAN = CapturePlan(
    (
        DarkSequence(exposures_s=(0.01,), frames=1),
        NarrowbandSequence(from_nm=450.0, to_nm=550.0, step_nm=50.0, passes=1),
    )
)


class FakePhotodiode(_Fake, Photodiode):
    """Sees the lamp, and a microampere when it is dark."""

    who = "photodiode"
    overloaded = False

    def measure_dark(self) -> float:
        assert self.bench.light == 0.0 or not self.bench.opened
        self.bench.log.append("dark current")
        return 1e-6

    def measure(self, wavelength_nm: float) -> IrradianceMeasurement:
        assert wavelength_nm == self.bench.wavelength_nm and self.bench.opened
        if self.overloaded:
            raise Refused("photodiode at here: overload; dim the light", 1)
        return IrradianceMeasurement(self.bench.light, 0.01 * self.bench.light, wavelength_nm, 1e-5, 10, 0.005)


def capture(store: Store, overloaded: bool = False, plan: CapturePlan = PLAN) -> tuple[CaptureSession, Bench]:
    bench = Bench()
    diode = FakePhotodiode(bench)
    diode.overloaded = overloaded

    def connect(asked: Station) -> Drivers:
        return replace(bench.drivers(), photodiode=diode)

    with_diode = station(photodiode={"driver": "fake", "address": "photodiode"})
    assert "photodiode" in with_diode.devices
    return CaptureSession.start(store, with_diode, plan, connect=connect), bench


def test_narrowband_captures_have_the_irradiance(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    session, bench = capture(store)
    assert session.run().state == "finished"
    assert bench.log.count("dark current") == 1
    recordings = store.recording_set(session.id)
    assert inspect(recordings)[0] == []
    captures = [one for one in recordings.captures("narrowband") if isinstance(one, NarrowbandCapture)]
    assert len(captures) == 2 * 3
    for one in captures:
        light = 0.05 * one.wavelength_nm / 500
        assert one.irradiance_w_m2 == pytest.approx(light)
        assert one.sd_irradiance_w_m2 == pytest.approx(0.01 * light)
        assert one.irradiance_calibration_sd_percent == pytest.approx(0.5)
        # by hand: a photon of 500 nm has 3.97289e-19 J
        photons = light / (3.97289e-19 * 500 / one.wavelength_nm)
        assert one.photon_irradiance_per_m2_s == pytest.approx(photons, rel=1e-5)
    assert store.runs(session.id)[-1].instruments["photodiode"].model == "photodiode"
    store.close()


def test_an_overloaded_photodiode_ends_the_run_in_one_line_with_the_shutter_closed(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    session, bench = capture(store, overloaded=True)
    with pytest.raises(DeviceError, match="photodiode at here: overload; dim the light"):
        session.run()
    assert not bench.opened
    store.close()


def test_flats_have_it_in_light_of_one_wavelength_alone(tmp_path: Path) -> None:
    store = Store(tmp_path / "data")
    plan = CapturePlan(
        (
            FlatSequence(levels=(0.2, 0.4), frames=2, wavelength_nm=500.0),
            FlatSequence(levels=(0.3,), frames=1),  # white light after it
        )
    )
    session, bench = capture(store, plan=plan)
    assert session.run().state == "finished"
    assert bench.log.count("dark current") == 1
    recordings = store.recording_set(session.id)
    assert inspect(recordings)[0] == []
    captures = [one for one in recordings.captures("flat") if isinstance(one, FlatCapture)]
    assert len(captures) == 2 * (2 * 2 + 1)
    for one in captures:
        if one.wavelength_nm is None:
            assert one.irradiance_w_m2 is None and one.irradiance_calibration_sd_percent is None
        else:
            assert (one.wavelength_nm, one.irradiance_w_m2) == (500.0, pytest.approx(0.05))
            assert one.irradiance_calibration_sd == pytest.approx(0.005)
            # sqrt(1 % ^2 - 0.5 % ^2)
            assert one.irradiance_readings_sd == pytest.approx(0.00866, rel=1e-3)
    assert sum(one.wavelength_nm is None for one in captures) == 2
    store.close()
