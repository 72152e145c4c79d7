"""Extensions from other packages, by entry points: found, used, and left out in one line where they are broken."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lab.effect_packages import drafted_package, package_files
from lab.formats.results import DiscoveredLaw

EFFECT = '''
from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.families import Family
from sim.effects.row_noise import RowNoise
from sim.parameters import Quantity
from sim.stages import Signal


class HumOfOurs(Effect):
    """A temporal disturbance of each row, as that of row_noise."""

    name: ClassVar[str] = "hum_of_ours"
    family: ClassVar[Family] = Family.LINE_NOISE
    reference: ClassVar[str] = "our bench"
    sentence: ClassVar[str] = "Each row is read with the mains' hum."

    noise_e: Annotated[
        float, Quantity("e", "standard deviation of a row", lower=0.0, upper=50.0, prior=(0.0, 1.0), absent=0.0,
                        linear_power=2)
    ] = 0.0

    def on_signal(self, signal: Signal) -> Signal:
        return RowNoise(noise_e=self.noise_e).on_signal(signal)


class Careless(HumOfOurs):
    name: ClassVar[str] = "careless"
    sentence: ClassVar[str] = "no full stop"
    noise_e: Annotated[float, Quantity("e", "of a row", lower=0.0, upper=50.0, prior=(0.0, 1.0), absent=0.0)] = 1.0
'''
OTHERS = """
from dataclasses import replace

import numpy as np
import typer

from lab.formats.importers import Importer
from lab.formats.recording_set import DataSheet, Manifest, RecordingSet
from lab.observables.observable import measurements
from sim.scene.chart import PatchChart
from sim.spectrum import Spectrum

LAMP = Spectrum.of((400.0, 700.0), (1.0, 2.0))


def read(path, options):
    sheet = DataSheet(rows=4, cols=6, cfa="MONO", bit_depth=12)
    capture = {"id": "a", "kind": "dark", "side": "left", "exposure_s": 0.01, "frame": "a.npy"}
    manifest = Manifest.model_validate({"cameras": {"left": sheet}, "captures": [capture]})
    return RecordingSet(manifest, {"a.npy": np.full((4, 6), 64, np.uint16)})


FORMAT = Importer(read)
GREYS = {f"{i}": Spectrum.of((380.0, 730.0), (i / 7, 0.5)) for i in range(6)}
CHART = PatchChart("six patches from grey to colours", 2, 3, GREYS, gap=0.2)
COMMANDS = typer.Typer()


@COMMANDS.command()
def greet() -> None:
    print("good morning")
"""
PERCENT = """
from sim.scene.chart import PatchChart
from sim.spectrum import Spectrum

CHART = PatchChart("in percent", 1, 1, {"white": Spectrum.of((380.0, 730.0), (90.0, 90.0))})
"""
POINTS = """[calibench.effects]
hum_of_ours = extension_of_ours:HumOfOurs
careless = extension_of_ours:Careless
misnamed = extension_of_ours:HumOfOurs
not_there = extension_of_ours:Nothing
breaks = extension_that_breaks:Effect
defocus = extension_of_ours:HumOfOurs
[calibench.importers]
ours = others_of_ours:FORMAT
fits = others_of_ours:FORMAT
[calibench.illuminants]
our-lamp = others_of_ours:LAMP
no-lamp = others_of_ours:read
[calibench.charts]
six-patches = others_of_ours:CHART
six-percent = chart_that_breaks:CHART
zone-plate = others_of_ours:CHART
ColorChecker24 = others_of_ours:CHART
no-chart = others_of_ours:LAMP
[calibench.observables]
dark = others_of_ours:LAMP
[calibench.capture_kinds]
nothing = others_of_ours:LAMP
[calibench.commands]
ours = others_of_ours:COMMANDS
no-commands = others_of_ours:LAMP
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which a package of extensions is installed, some of them broken."""
    folder = tmp_path_factory.mktemp("installed")
    (folder / "extension_of_ours.py").write_text(EFFECT)
    (folder / "others_of_ours.py").write_text(OTHERS)
    (folder / "extension_that_breaks.py").write_text("1 / 0\n")
    (folder / "chart_that_breaks.py").write_text(PERCENT)
    (folder / "our_effects-0.1.dist-info").mkdir()
    (folder / "our_effects-0.1.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: our-effects\nVersion: 0.1\n"
    )
    (folder / "our_effects-0.1.dist-info" / "entry_points.txt").write_text(POINTS)
    paths = [str(folder), str(Path(__file__).parents[2])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}


def run(environment: dict[str, str], *arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False)


def test_an_effect_of_another_package_is_listed_and_broken_ones_are_a_line_each(environment: dict[str, str]) -> None:
    done = run(environment, "-m", "calibench", "effects", "list", "hum_of_ours")
    assert done.returncode == 0 and "Each row is read with the mains' hum." in done.stdout, done.stderr
    for name, why in (
        ("not_there", "can't be loaded (AttributeError"),
        ("breaks", "can't be loaded (ZeroDivisionError: division by zero)"),
        ("misnamed", "its entry point's name isn't that of the effect, 'hum_of_ours'"),
        ("defocus", "its entry point's name isn't that of the effect"),
    ):
        (line,) = {one for one in done.stderr.splitlines() if f"calibench.effects: {name}: " in one and why in one
                   and not one.startswith("calibench: warning")}  # fmt: skip
        assert line.endswith("it is left out: mend its package, or remove it")
    assert "Traceback" not in done.stderr


def test_a_command_of_another_package_runs_and_what_is_none_is_a_line(environment: dict[str, str]) -> None:
    done = run(environment, "-m", "calibench", "greet")
    assert (done.returncode, done.stdout) == (0, "good morning\n"), done.stderr
    assert "calibench.commands: no-commands: " in done.stderr and "is no typer.Typer; it is left out" in done.stderr


@pytest.mark.parametrize(
    ("package", "code", "said"),
    [
        ("hum_of_ours", 0, "hum_of_ours: keeps the contract of effects"),
        ("Our.Effects", 4, "careless: noise_e: its default is 1.0, not its `absent`, 0.0"),
        ("our-effects", 4, "careless: sentence: write one that ends in a full stop"),
        ("our_effects", 4, "breaks: calibench.effects: breaks: extension_that_breaks:Effect can't be loaded"),
        ("none-such", 2, "no installed package of that name adds an effect; installed are breaks, careless, "),
    ],
)
def test_the_contract_runs_on_a_package_by_its_name(
    package: str, code: int, said: str, environment: dict[str, str]
) -> None:
    done = run(environment, "-m", "calibench", "check-effect", package)
    assert done.returncode == code and said in done.stdout + done.stderr, done.stdout + done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("package", "code", "said"),
    [
        ("six-patches", 0, "six-patches: keeps the contract of charts"),
        ("our-effects", 4, "can't be loaded (ValueError: patch white: reflectance 90 is outside 0..1"),
        ("zone-plate", 4, "zone-plate: a scene or a chart of calibench has that name; it is left out"),
        ("none-such", 2, "no installed package of that name adds a chart; installed are ColorChecker24, no-chart, six"),
    ],
)  # fmt: skip
def test_the_contract_of_charts_runs_on_a_package_by_its_name(
    package: str, code: int, said: str, environment: dict[str, str]
) -> None:
    done = run(environment, "-m", "calibench", "check-chart", package)
    assert done.returncode == code and said in " ".join((done.stdout + done.stderr).split()), done.stdout + done.stderr
    assert "Traceback" not in done.stderr


def test_a_chart_is_a_scene_and_broken_ones_are_a_line_each(environment: dict[str, str]) -> None:
    done = run(environment, "-m", "calibench", "simulate", "list")
    assert done.returncode == 0 and "six patches from grey to colours" in done.stdout, done.stderr
    assert "gap=0.2" in done.stdout and done.stdout.count("zone-plate") == 1
    for name in ("six-percent", "zone-plate", "ColorChecker24", "no-chart"):
        assert sum(f"calibench.charts: {name}: " in line for line in done.stderr.splitlines()) == 1, done.stderr
    assert "Traceback" not in done.stderr


def test_formats_and_illuminants_are_added(environment: dict[str, str], tmp_path: Path) -> None:
    code = (
        "import calibench; from pathlib import Path; Path('x').write_text('')\n"
        "found = calibench.open_recordings('x', kind='ours'); print(found.frame(found.captures()[0]).mean())\n"
        "print(calibench.simulate('uniform', illuminant='Our-Lamp', exposure_s=0.01).record.options.illuminant)\n"
        "from lab.observables.observable import measurements; print(len(measurements()) > 10)\n"
        "from sim.extensions import refused; print(*refused(), sep='\\n')"
    )
    done = run(environment, "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[:3] == ["64.0", "Our-Lamp", "True"]
    for group, name in (("importers", "fits"), ("illuminants", "no-lamp"), ("observables", "dark"),
                        ("capture_kinds", "nothing")):  # fmt: skip
        assert sum(line.startswith(f"calibench.{group}: {name}: ") for line in lines) == 1, lines


LAW = DiscoveredLaw(
    side="left", stage="signal", along="row", period=8, table=(0.5, -0.1, -0.1, -0.1, -0.1, 0.0, 0.0, -0.1),
    shown_period=8, shown_departure=(0.5,) * 8, shown_std=(0.1,) * 8, chi2_before=500.0, chi2_after=50.0, n=50,
    suspects="the read-out does that", statement="No named effect accounts for this: every eighth row is high.",
)  # fmt: skip


def test_a_drafted_package_keeps_the_contract_where_it_is_installed(
    environment: dict[str, str], tmp_path: Path
) -> None:
    """Its module and its entry point, where pip would put them; its own test passes."""
    folder = tmp_path / "eighth_row"
    folder.mkdir()
    for file, text in zip(package_files(folder), drafted_package(LAW, 1, "set", folder), strict=True):
        file.write_text(text)
    place = folder / "calibench_effect_eighth_row-0.1.0.dist-info"
    place.mkdir()
    (place / "METADATA").write_text("Metadata-Version: 2.1\nName: calibench-effect-eighth-row\nVersion: 0.1.0\n")
    (place / "entry_points.txt").write_text("[calibench.effects]\neighth_row = eighth_row:EighthRow\n")
    there = environment | {"PYTHONPATH": os.pathsep.join([str(folder), str(Path(__file__).parents[2])])}
    done = run(there, "-m", "calibench", "check-effect", "calibench-effect-eighth-row")
    assert done.returncode == 0 and "eighth_row: keeps the contract of effects" in done.stdout, (
        done.stdout + done.stderr
    )
    tested = run(there, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(folder), cwd=tmp_path)
    assert tested.returncode == 0, tested.stdout
    project = (folder / "pyproject.toml").read_text()
    assert 'eighth_row = "eighth_row:EighthRow"' in project and 'py-modules = ["eighth_row"]' in project
