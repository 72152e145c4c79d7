"""`calibench devices` and `calibench station`: what they print, and their exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from lab.cli import main
from mocks.peers import PromptPeer, lit_bench, specbos1211
from mocks.usb import serve_usbip, stereo_pair


class MutePeer(PromptPeer):
    """A person who never answers."""

    def __init__(self) -> None:
        super().__init__()
        self.mute(True)


def test_what_is_connected_and_a_station_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "station.toml"
    bench = lit_bench()
    bench.expose("right", 0.005)  # drawn once, which takes longer than a camera may
    with serve_usbip(stereo_pair(bench)) as server:
        where = "{}:{}".format(*server.address)
        assert main(["devices", "--usbip", where]) == 0
        said = capsys.readouterr().out
        assert f"usbip://{where}/CB-U3V-0001" in said
        assert "camera.u3v" in said
        assert main(["station", "init", str(file), "--usbip", where]) == 0
        assert main(["devices", "check", str(file)]) == 0
        assert "works  camera left  calibench Mock U3V 480x640 CB-U3V-0001" in capsys.readouterr().out
    assert main(["station", "init", str(file)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["devices", "check", str(file)]) == 3
    assert "2 of the station's instruments do not work" in capsys.readouterr().err
    assert main(["devices", "--usbip", "127.0.0.1:1"]) == 3


def test_a_port_is_probed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with specbos1211() as peer:
        assert main(["devices", "--probe", peer.address]) == 0
        assert "JETI specbos 1211 1211427" in capsys.readouterr().out
        peer.mute(True)
        assert main(["devices", "--probe", peer.address]) == 3
        assert "none of these drivers' instruments answers there" in capsys.readouterr().err
    assert main(["devices", "--probe", str(tmp_path / "none")]) == 3
    assert "can't be opened (No such file or directory)" in capsys.readouterr().err


def test_a_contract_that_is_kept_and_one_that_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "contract.toml"
    file.write_text('[[instrument]]\ndriver = "stage.prompt"\npeer = "mocks.peers:prompt_stage"\n')
    assert main(["devices", "contract", str(file)]) == 0
    assert "met       stage.prompt  says who it is, and is let go" in capsys.readouterr().out
    file.write_text('[[instrument]]\ndriver = "stage.prompt"\npeer = "tests.lab.cli.test_devices:MutePeer"\n')
    assert main(["devices", "contract", str(file)]) == 4
    assert "checks not met" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("", 2, "names no instrument"),
        ("[[instrument", 2, "isn't TOML"),
        ('[[instrument]]\npeer = "x:y"', 2, "without driver"),
        ('[[instrument]]\ndriver = "stage.prompt"', 2, "needs either peer or address"),
        ('[[instrument]]\ndriver = "stage.prompt"\npeer = "nowhere:x"', 3, "peer 'nowhere:x' can't be loaded"),
        ('[[instrument]]\ndriver = "oven.x"\naddress = ""', 3, "oven: no such family"),
    ],
)
def test_what_cannot_be_used_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, code: int, said: str
) -> None:
    file = tmp_path / "contract.toml"
    file.write_text(text)
    assert main(["devices", "contract", str(file)]) == code
    errors = capsys.readouterr().err
    assert said in " ".join(errors.split())
