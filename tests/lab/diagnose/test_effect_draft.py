"""Discovered laws as drafts of effects: of every place in the chain they pass the contract of effects as they stand."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from evaluation.independent_simulator.law import Array
from lab import cli
from lab.diagnose.effect_draft import draft, place_of_test
from lab.formats.recording_set import write
from lab.formats.results import DiscoveredLaw
from sim.effects.empirical_law import PLACES

ROOT = Path(__file__).resolve().parents[3]
#: Runs pytest with the effects of one more folder.
CONTRACT = """
import sys
import pytest
import sim.effects
sim.effects.__path__.append(sys.argv[1])
sys.exit(pytest.main([*sys.argv[2:], "-q", "-p", "no:cacheprovider", "--no-header"]))
"""
#: A camera of the former whose frames a drafted effect changes, diagnosed with the draft in the list.
CONCEALED = """
import json
import sys
import sim.effects
sim.effects.__path__.append(sys.argv[1])
from evaluation.draw import recordings_of
from lab.diagnose import diagnose
from evaluation.independent_simulator import ConcealedCamera, Law, Plan
from sim.effects.library import effect
from sim.stages import codes_of

class Drafted(Law):
    name, nominal, limits = "drafted", 1.0, (0.0, 1.0)

    def adc_output(self, dn):
        return codes_of(None, (effect(sys.argv[2])(strength=1.0),)).convert(dn)

camera = ConcealedCamera(772302, (Drafted(1.0),), rows=96, cols=128, cfa="MONO")
found = diagnose(recordings_of(camera, Plan(("dark", "flat", "narrowband"))), None)
print(json.dumps({one.name: one.parameters["strength"].value for one in found.effects if "strength" in one.parameters}))
"""


def _run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False, timeout=300)


def _law(stage: str, along: str, of: str) -> DiscoveredLaw:
    """A law of some per cent, or some electrons, at one place of the chain."""
    none, rng = PLACES[stage, along, of][1], np.random.default_rng(3)  # type: ignore[index]
    departure = np.append(0.0, 0.05 * rng.random(5)) if none else np.append(0.0, 3.0 * rng.random(5))
    reach = {"level": 8000.0, "radius": 400.0, "time": 900.0, "frequency": 0.2, "angle": 360.0, "plane x time": 900.0,
             "radius x exposure": 400.0}.get(along, 1.0)  # fmt: skip
    if along == "radius x exposure":
        departure = 1e-5 * departure
    if along == "angle":
        departure[-1] = departure[0]
    at: tuple[float, ...] = tuple(np.linspace(0.0, reach, 6).tolist())
    period = columns = 0
    if along == "wavelength":
        at = tuple(np.linspace(400.0, 700.0, 6).tolist())
    if along == "row and column":
        period, columns, departure = 4, 4, np.tile(0.05 * rng.standard_normal(4), 4) * (1.0 if none else 50.0)
    if along in {"code", "row", "column", "row x level", "column x level"}:
        period = 6
    if period:
        at = ()
        departure = departure - departure.mean() if of == "mean" else departure
    return DiscoveredLaw(
        side="left", stage=stage, along=along, of=of, period=period, columns=columns, at=at,
        table=tuple((none + departure).tolist()), shown_period=period, shown_departure=tuple(departure.tolist()),
        shown_std=(0.01,) * len(departure), chi2_before=900.0, chi2_after=100.0, n=100,
        suspects='a "made" law does that', statement="No named effect accounts for this: a made law.",
    )  # fmt: skip


def test_a_draft_of_every_place_passes_the_contract(tmp_path: Path) -> None:
    """The contract of all effects as it stands, and each draft's own test."""
    for number, place in enumerate(PLACES):
        file = tmp_path / f"drafted_{number}.py"
        for path, text in zip((file, place_of_test(file)), draft(_law(*place), 1, "a set", file), strict=True):
            path.write_text(text, encoding="utf-8")
    steps = _law("charge", "column", "mean").model_copy(update={"period": 0, "at": (0.49, 0.51), "table": (0.99, 1.01)})
    file = tmp_path / "drafted_steps.py"
    for path, text in zip((file, place_of_test(file)), draft(steps, 1, "a set", file), strict=True):
        path.write_text(text, encoding="utf-8")
    own = [str(path) for path in sorted(tmp_path.glob("test_*.py"))]
    done = _run(CONTRACT, str(tmp_path), "tests/sim/effects/test_effects.py", *own, "-k", "drafted")
    assert done.returncode == 0, done.stdout[-3000:]
    assert len(own) == len(PLACES) + 1
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", str(ROOT / "pyproject.toml"), str(tmp_path)],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout


WIDTHS = np.array([1.15, 0.95, 0.9, 1.1, 0.9])


class FiveWidths(Law):
    """The codes' widths repeat every five: no weights of bits do that."""

    name, nominal, limits = "five_widths", 1.0, (0.0, 1.0)

    def adc_output(self, dn: Array) -> Array:
        begins = np.append(0.0, np.cumsum(WIDTHS)[:-1])
        whole = 5.0 * np.floor((dn + 0.5) / 5.0)
        return whole + np.searchsorted(begins, dn + 0.5 - whole, side="right") - 1.0


@pytest.mark.extra  # two whole diagnoses
def test_a_law_of_a_set_is_drafted_concealed_and_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a recording set, as a user does it. The draft in the former's converter is named, and whole.

    A session counts some 1e5 pixels of each of the five widths, which differ by 10 %: the share is known to 0.05.
    """
    camera = ConcealedCamera(772302, (FiveWidths(1.0),), rows=96, cols=128, cfa="MONO")
    recordings = recordings_of(camera, Plan(("dark", "flat", "narrowband")))
    folder, file = write(recordings, tmp_path / "set"), tmp_path / "five_widths.py"
    arguments = ["effects", "draft", str(folder), "--law", "1", "--out", str(file)]
    assert cli.main(arguments) == 0
    assert str(place_of_test(file)) in capsys.readouterr().out
    own = str(place_of_test(file))
    done = _run(CONTRACT, str(tmp_path), "tests/sim/effects/test_effects.py", own, "-k", "five_widths")
    assert done.returncode == 0, done.stdout[-3000:]
    done = _run(CONCEALED, str(tmp_path), "five_widths")
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout)["five_widths"] == pytest.approx(1.0, abs=0.05)
    for changed, said in (
        (arguments, "is there already"),
        ([*arguments[:-3], "2", "--out", str(tmp_path / "other.py")], "laws 1 to 1 were discovered"),
        ([*arguments[:-1], str(tmp_path / "blooming.py")], "there is an effect named blooming already"),
        ([*arguments[:-1], str(tmp_path / "Not An Effect.py")], "an effect is named after its file"),
        ([*arguments[:-1], str(tmp_path / "none" / "x.py")], "can't be written"),
    ):
        assert cli.main(changed) == 2
        assert said in capsys.readouterr().err
