"""The files of a laboratory's installation: systemd's units, udev's rules, and the page that goes through them."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from seabreeze.pyseabreeze.transport import USBTransport
from typer.main import get_command

from drivers.monochromator.cornerstone260b import MODELS, VENDOR
from lab.cli.entry import add_commands, app

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
UNITS = sorted(file.name for file in DEPLOY.iterdir() if file.suffix in (".service", ".timer"))
PAGE = ROOT / "docs" / "how-to" / "install-in-a-lab.md"
#: A key of udev's rules: what it may match or set, and how.
RULE_PART = re.compile(
    r'(?:ACTION|SUBSYSTEM|SUBSYSTEMS|ENV\{\w+\}|ATTR\{\w+\})=="[^"]*"|(?:GROUP|MODE|GOTO|LABEL)="[^"]*"|TAG\+="[^"]*"'
)


def unit(name: str) -> dict[str, dict[str, list[str]]]:
    """The sections of a unit; a key may be there several times."""
    found: dict[str, dict[str, list[str]]] = {}
    section = ""
    for line in (DEPLOY / name).read_text().splitlines():
        if re.fullmatch(r"\[\w+\]", line):
            section = line[1:-1]
            found[section] = {}
        elif line and not line.startswith("#"):
            key, mark, value = line.partition("=")
            assert mark and re.fullmatch(r"[A-Z]\w+", key), line
            found[section].setdefault(key, []).append(value)
    return found


def test_systemd_takes_the_units(tmp_path: Path) -> None:
    """`systemd-analyze verify` where there is one, with programs that exist in place of those of the installation."""
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        for name in UNITS:
            assert unit(name)["Unit"]["Description"]
        return
    for name in UNITS:
        text = (DEPLOY / name).read_text().replace("/opt/calibench/bin/calibench", sys.executable)
        (tmp_path / name).write_text(text)
    files = [str(tmp_path / name) for name in UNITS]
    done = subprocess.run([analyze, "verify", *files], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and str(tmp_path) not in done.stderr, done.stderr
    broken = tmp_path / "calibench.service"
    broken.write_text(broken.read_text().replace("Type=exec", "Type=nonsense"))
    done = subprocess.run([analyze, "verify", str(broken)], capture_output=True, text=True, check=False)
    assert "nonsense" in done.stderr  # it does look


def test_the_service_may_do_little(tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is not None:
        options = ["--offline=true", "--threshold=30"]  # systemd's score of what an intruder could do, of 100
        command = [analyze, "security", *options, str(DEPLOY / "calibench.service")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-300:]
    service = unit("calibench.service")["Service"]
    assert service["User"] == ["calibench"] and service["NoNewPrivileges"] == ["yes"]
    assert "MemoryDenyWriteExecute" not in service  # numba compiles


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_the_commands_of_the_units_are_calibenchs(name: str) -> None:
    """Program, command and every option exist."""
    add_commands()
    (line,) = unit(name)["Service"]["ExecStart"]
    program, command, *arguments = line.split()
    assert program == "/opt/calibench/bin/calibench"
    context = get_command(app).make_context("calibench", [command], resilient_parsing=True)
    found = context.command.get_command(context, command)  # type: ignore[attr-defined]
    known = {option for parameter in found.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert {argument for argument in arguments if argument.startswith("--")} <= known
    assert "--create-first-key" not in arguments  # a key would stand in the journal
    timeout_s = unit("calibench.service")["Service"]["TimeoutStopSec"]
    assert int(timeout_s[0]) > 60  # a session is given a minute to close its shutter


def test_the_timer_starts_the_backup() -> None:
    timer = configparser.ConfigParser(interpolation=None)
    timer.read(DEPLOY / "calibench-backup.timer")
    assert (DEPLOY / "calibench-backup.service").exists() and timer["Timer"]["OnCalendar"]


def rules() -> list[str]:
    lines = (DEPLOY / "70-calibench.rules").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def test_udevs_rules_are_well_formed() -> None:
    assert len(rules()) > 25
    for line in rules():
        assert all(RULE_PART.fullmatch(part) for part in line.split(", ")), line
        if "SUBSYSTEM==" in line:
            assert line.endswith('GROUP="calibench", MODE="0660", TAG+="uaccess"'), line
    labels = [line for line in rules() if line.startswith("LABEL")]
    assert labels == ['LABEL="calibench_end"'] and 'GOTO="calibench_end"' in rules()[0]


def test_udevs_rules_name_every_usb_instrument_that_a_driver_looks_for() -> None:
    named = set()
    for line in rules():
        if found := re.search(r'idVendor\}=="(\w{4})".*idProduct\}=="(\w{4})"', line):
            named.add((int(found[1], 16), int(found[2], 16)))
    assert named == {(VENDOR, product) for product in MODELS} | set(USBTransport.vendor_product_ids)
    assert any(":ef0500:" in line for line in rules())  # USB3 Vision, by its class


def test_the_page_goes_through_every_file() -> None:
    text = PAGE.read_text()
    for file in DEPLOY.iterdir():
        assert file.name in text, file.name
