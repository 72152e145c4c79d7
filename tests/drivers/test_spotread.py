"""Argyll's spotread measures on the mocks of JETI's instruments: it knows nothing of calibench."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

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
mkdir -p "$dev/bus/usb/001" "$dev/pts"
touch "$dev/null" "$dev/tty"
mount --bind /dev/null "$dev/null"
mount --rbind /dev/pts "$dev/pts"
ln -s "$line" "$dev/ttyUSB0"
mount --rbind "$dev" /dev
exec spotread "$@"
"""


def _spotread(folder: Path, line: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Let spotread measure on a line. Skips the test where there is none, or no name space of its own for it."""
    if shutil.which("spotread") is None:
        missing("spotread isn't installed (scripts/install-peers)")
    apart = ["unshare", "--map-root-user", "--mount"]
    if subprocess.run([*apart, "true"], capture_output=True, check=False).returncode:
        apart = ["unshare", "--mount"]
    command = [*apart, "sh", "-c", ALONE, "sh", str(folder / "dev"), line, *arguments]
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
