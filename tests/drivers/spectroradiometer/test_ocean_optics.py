"""The USB2000+'s driver on its mock: the radiance of the light in front, whatever the instrument's dark, bend and
response."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import usb.core

from drivers.errors import Disconnected, Garbled, InstrumentError, Interrupted
from drivers.registry import driver
from drivers.spectroradiometer.ocean_optics import OceanOptics
from mocks import usb as mock_usb
from mocks.bench import Bench
from mocks.usb2000plus import NOISE_COUNTS, calibration_csv, response
from mocks.wire import parse_faults


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.place("sphere")
    bench.set_wavelength(0.0)
    bench.set_shutter(True)
    return bench


@pytest.fixture
def calibration(tmp_path: Path) -> str:
    file = tmp_path / "calibration.csv"
    file.write_text(calibration_csv())
    return str(file)


def plugged(bench: Bench) -> usb.core.Device:
    return usb.core.find(backend=mock_usb.backend("usb2000plus", bench))


def test_radiance_of_white_light(bench: Bench, calibration: str) -> None:
    with OceanOptics("usb://x", calibration=calibration, device=plugged(bench)) as meter:
        identity = meter.identity()
        assert (identity.model, identity.serial_number) == ("USB2000+", "USB2+F00001")
        found = meter.measure()
    at = np.arange(400.0, 721.0, 5.0)
    # The bench gives each call 0.15 % of noise, which 1.5 nm of slit and 4 scans average to under 0.1 %; counts have 22
    # of noise.
    counts = found.radiance_w_sr_m2_nm.at(at) * response(at) * (found.integration_time_s or np.nan)
    sigma = np.hypot(0.0015, NOISE_COUNTS / np.sqrt(4 * 2.7) / counts)
    truth = np.mean([bench.radiance().at(at) for _ in range(50)], axis=0)
    assert np.all(np.abs(found.radiance_w_sr_m2_nm.at(at) / truth - 1.0) < 4.0 * sigma)
    assert found.serial_number == identity.serial_number


def test_a_line_keeps_its_power_and_place(bench: Bench, calibration: str) -> None:
    bench.set_wavelength(550.0)
    with OceanOptics("usb://x", calibration=calibration, device=plugged(bench)) as meter:
        found = meter.measure().radiance_w_sr_m2_nm
    truth = bench.radiance()
    assert found.integral(520.0, 580.0) == pytest.approx(truth.integral(520.0, 580.0), rel=0.003)
    w, value = found.arrays
    near = (w > 530) & (w < 570)
    wt, vt = truth.arrays
    near_t = (wt > 530) & (wt < 570)
    centroid, true = np.average(w[near], weights=value[near]), np.average(wt[near_t], weights=vt[near_t])
    assert centroid == pytest.approx(true, abs=0.05)


def test_over_the_network_by_the_registry(bench: Bench, calibration: str) -> None:
    devices = mock_usb.devices("usb2000plus", bench)
    with mock_usb.serve_usbip(devices, "127.0.0.1", 0) as server:
        make = driver("spectroradiometer", "usb2000plus")
        meter = make(server.url("USB2+F00001"), calibration=calibration, averages=1)
        with meter:
            assert meter.measure().radiance_w_sr_m2_nm.integral() > 0


def test_too_dark_says_so(bench: Bench, calibration: str) -> None:
    bench.set_shutter(False)
    with OceanOptics("usb://x", calibration=calibration, device=plugged(bench)) as meter:
        with pytest.raises(InstrumentError, match=r"under-exposed.*max_integration_s"):
            meter.measure()
        bench.set_shutter(True)
        assert meter.measure().radiance_w_sr_m2_nm.integral() > 0


def test_too_bright_says_so(bench: Bench, calibration: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocks.usb2000plus.response", lambda w: 1e12 * np.ones_like(w))
    with (
        OceanOptics("usb://x", calibration=calibration, device=plugged(bench)) as meter,
        pytest.raises(InstrumentError, match=r"over-exposed at its shortest time"),
    ):
        meter.measure()


def test_unplugged_and_plugged_again(bench: Bench, calibration: str) -> None:
    backend = mock_usb.backend("usb2000plus", bench)
    meter = OceanOptics("usb://x", calibration=calibration, device=usb.core.find(backend=backend))
    meter.connect()
    backend.plugged_in[0].unplug()
    with pytest.raises(Disconnected):
        meter.measure()
    backend.plugged_in[0].plug()
    assert meter.measure().radiance_w_sr_m2_nm.integral() > 0
    meter.close()
    meter.close()


@pytest.mark.parametrize(
    ("fault", "message"), [("half@1", "a spectrum that isn't whole"), ("wrong@1", "covered pixels, without any noise")]
)
def test_a_broken_spectrum_is_told_and_the_next_is_good(
    bench: Bench, calibration: str, fault: str, message: str
) -> None:
    backend = mock_usb.backend("usb2000plus", bench)
    with OceanOptics("usb://x", calibration=calibration, device=usb.core.find(backend=backend), averages=1) as meter:
        meter.connect()
        backend.plugged_in[0].fail(parse_faults(fault))
        with pytest.raises(Garbled, match=message) as caught:
            meter.measure()
        assert "\n" not in str(caught.value)
        assert meter.measure().radiance_w_sr_m2_nm.integral() > 0


def test_stop_ends_a_measurement(bench: Bench, calibration: str) -> None:
    with OceanOptics("usb://x", calibration=calibration, device=plugged(bench), averages=10**6) as meter:
        timer = threading.Timer(0.5, meter.stop)
        timer.start()
        with pytest.raises(Interrupted):
            meter.measure()
        timer.join()


def test_another_device_is_refused(bench: Bench, calibration: str) -> None:
    other = usb.core.find(backend=mock_usb.backend("cornerstone260b", bench))
    with pytest.raises(InstrumentError, match=r"1fde:0014 is no spectrometer"):
        OceanOptics("usb://x", calibration=calibration, device=other).connect()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "calibration.csv"),
        ("wavelength_nm,counts\n400,1\n500,1\n", "the columns are wavelength_nm,counts"),
        ("wavelength_nm,counts_per_s_per_w_sr_m2_nm\n400,1\n500\n", "calibration.csv"),
        ("wavelength_nm,counts_per_s_per_w_sr_m2_nm\n400,1\n500,-1\n", "above 0"),
        ("wavelength_nm,counts_per_s_per_w_sr_m2_nm\n500,1\n400,1\n", "ascend"),
        ("wavelength_nm,counts_per_s_per_w_sr_m2_nm\n200,1\n300,1\n", "outside the calibration"),
    ],
)
def test_a_bad_calibration_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "calibration.csv"
    file.write_text(text)
    with pytest.raises(InstrumentError, match=said) as caught:
        OceanOptics("usb://x", calibration=str(file))
    assert "\n" not in str(caught.value)


def test_a_missing_calibration_is_one_line() -> None:
    with pytest.raises(InstrumentError, match=r"calibration file absent\.csv"):
        OceanOptics("usb://x", calibration="absent.csv")
