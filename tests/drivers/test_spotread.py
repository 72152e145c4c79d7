"""Argyll's spotread measures on the mocks of JETI's instruments: it knows nothing of calibench. And the driver
`argyll` measures through it."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import Disconnected, Refused
from drivers.spectroradiometer.argyll import Argyll
from mocks.lamp import Lamp, tristimulus
from mocks.peers import LinePeer
from mocks.specbos1211 import MockSpecbos1211
from tests.peers import missing

pytestmark = pytest.mark.extra  # Argyll's spotread

#: Where there is no /dev/bus/usb, Argyll takes every device in /dev for a USB device, and waits for its description: at
#: a serial line without end. So it is shown a /dev of its own: the mock's line, and a USB bus with nothing on it.
#: It knows a line on which an instrument may be by its name.
ALONE = """
set -eu
dev="$1"; line="$2"; shift 2
rm -rf "$dev"
mkdir -p "$dev/bus/usb/001" "$dev/pts"
touch "$dev/null" "$dev/tty"
mount --bind /dev/null "$dev/null"
mount --rbind /dev/pts "$dev/pts"
ln -s "$line" "$dev/ttyUSB0"
mount --rbind "$dev" /dev
exec spotread "$@"
"""


def _alone(folder: Path, line: str) -> list[str]:
    """Return spotread with nothing but a line to be seen. Skips the test where there is none, or no name space of its
    own for it."""
    if shutil.which("spotread") is None:
        missing("spotread isn't installed (scripts/install-peers)")
    apart = ["unshare", "--map-root-user", "--mount"]
    if subprocess.run([*apart, "true"], capture_output=True, check=False).returncode:
        apart = ["unshare", "--mount"]
    return [*apart, "sh", "-c", ALONE, "sh", str(folder / "dev"), line]


def _spotread(folder: Path, line: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Let spotread measure on a line."""
    command = [*_alone(folder, line), *arguments]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120, check=False, cwd=folder
    )


@pytest.mark.parametrize("model", ["spectraval 1501", "specbos 1211"])
def test_spotread_measures_the_lamp(tmp_path: Path, model: str) -> None:
    with LinePeer(lambda light: MockSpecbos1211(light, model=model), light=Lamp(50.0)) as peer:
        line = str(Path(peer.address).resolve())
        done = _spotread(tmp_path, line, "-e", "-O", "-s", "-c", "1", "spot.txt")
    found = re.search(r"Result is XYZ: (\S+) (\S+) (\S+)", done.stdout)
    assert found is not None, (done.stdout + done.stderr)[-2000:]
    x, y, z = (float(value.rstrip(",")) for value in found.groups())
    assert (x, y, z) == pytest.approx(tristimulus(Lamp(50.0).radiance()), rel=1e-3)


@pytest.mark.parametrize("address", ["1", "spectraval"])
def test_the_driver_measures_through_spotread(tmp_path: Path, address: str) -> None:
    lamp = Lamp(50.0)
    with LinePeer(lambda light: MockSpecbos1211(light, model="spectraval 1501"), light=lamp) as peer:
        program = shlex.join(_alone(tmp_path, str(Path(peer.address).resolve())))
        with Argyll(address, program=program, high_resolution=True) as radiometer:
            assert radiometer.identity().serial_number == "1211427"
            assert radiometer.departures() == ("it has no spectra in finer steps: high_resolution is ignored",)
            wavelength_nm, value = radiometer.measure().radiance_w_sr_m2_nm.arrays
            peer.unplug()
            with pytest.raises(Disconnected, match="doesn't answer its program"):
                radiometer.measure()
    np.testing.assert_array_equal(wavelength_nm, np.arange(350.0, 831.0))
    np.testing.assert_allclose(value, lamp.radiance().at(wavelength_nm), rtol=6e-6)  # six digits are printed


def test_too_much_light_is_refused_in_spotreads_words(tmp_path: Path) -> None:
    with LinePeer(lambda light: MockSpecbos1211(light, model="spectraval 1501"), light=Lamp(1e9)) as peer:
        program = shlex.join(_alone(tmp_path, str(Path(peer.address).resolve())))
        with (
            Argyll("1", program=program) as radiometer,
            pytest.raises(Refused, match=r"\(Overexposure\); dim the light"),
        ):
            radiometer.measure()


def test_no_spotread_is_left_where_its_driver_is_killed(tmp_path: Path) -> None:
    """spotread doesn't notice the end of its input: without more it would hold the port."""
    with LinePeer(lambda light: MockSpecbos1211(light, model="spectraval 1501"), light=Lamp(50.0)) as peer:
        program = shlex.join(_alone(tmp_path, str(Path(peer.address).resolve())))
        code = (
            "import sys, time; from drivers.spectroradiometer.argyll import Argyll\n"
            "made = Argyll('1', program=sys.argv[1]); made.connect()\n"
            "print(made._line.pid, flush=True); time.sleep(300)"
        )
        environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
        with subprocess.Popen([sys.executable, "-c", code, program], stdout=subprocess.PIPE, env=environment) as host:
            assert host.stdout is not None
            group = int(host.stdout.readline())
            host.kill()
        until = time.monotonic() + 30.0
        while time.monotonic() < until and _lives(group):
            time.sleep(0.05)
        assert not _lives(group)


def _lives(group: int) -> bool:
    """Return whether a process of a group runs, one that nobody has taken leave of left out."""
    listed = subprocess.run(["ps", "-eo", "pgid=,stat="], capture_output=True, text=True, check=True).stdout
    return any(one.split()[0] == str(group) and not one.split()[1].startswith("Z") for one in listed.splitlines())
