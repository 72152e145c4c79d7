"""`calibench capture` and `calibench run`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lab.cli.bench_process import mock_bench
from lab.cli.console import err, out, warn, write_json
from lab.cli.sources import examined, fit_or_read, open_store, save_models, stored_recordings, validated
from lab.cli.tables import print_fit
from lab.formats.recording_set import RecordingSet
from lab.formats.results import FitResult

if TYPE_CHECKING:
    from lab.capture.sequences.calibration import Calibration
    from lab.capture.store import Store
    from lab.diagnose import Diagnosis

commands = typer.Typer()


StationFile = Annotated[
    Path | None, typer.Option("--station", metavar="FILE", help="the station file; without one, the mock bench")
]
Quick = Annotated[bool, typer.Option("--quick", help="fewer exposures and repeats")]
DataFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)")
]
Resume = Annotated[str, typer.Option(metavar="SESSION", help="go on with this session")]


@commands.command()
def capture(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Annotated[str, typer.Option(help="what the session is called")] = "",
    resume: Resume = "",
) -> None:
    """Run the sequences of a station and keep what was captured. Without a station file: on the mock bench."""
    store = open_store(out_folder)
    session_id = _captured(store, station, quick, name, resume)
    out.print(f"session: {session_id}")


@commands.command()
def run(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Annotated[str, typer.Option(help="what the session is called")] = "",
    resume: Resume = "",
    resolve: Annotated[
        bool,
        typer.Option(
            "--resolve", help="where rivals are left, take the capture that tells them apart, and decide again"
        ),
    ] = False,
) -> None:
    """The main job: capture, fit, validate, diagnose, report. Without a station file: on the mock bench."""
    from lab.report import provenance_of, words, write_report

    store = open_store(out_folder)
    session_id = _captured(store, station, quick, name, resume)
    recordings = stored_recordings(store, session_id)
    warn(recordings.warnings)
    fitted = fit_or_read(recordings, None)
    validation = validated(recordings, fitted)
    found = examined(recordings, fitted)
    if resolve:
        found = _resolved(store, station, recordings, fitted, found)
    diagnosis = found.result
    folder = store.folder(session_id)
    save_models(recordings, found, folder / "cameras")
    for kind, result in (("fit", fitted), ("validate", validation), ("diagnose", diagnosis)):
        store.add_result(kind, session_id, result.model_dump(mode="json"))
        write_json(result, folder / f"{kind}.json")
    runs = store.runs(session_id)
    provenance = provenance_of(recordings, runs[-1].instruments if runs else {})
    page = write_report(folder / "report.html", recordings, fitted, validation, diagnosis, provenance)
    print_fit(recordings, fitted)
    badge, _, headline = words.headline(diagnosis)
    out.print(f"\n[bold]{badge}[/]: {headline}")
    for sentence in words.summary(fitted, validation, diagnosis):
        out.print(escape(sentence))
    if diagnosis.next_capture:
        out.print(f"Next: {escape(diagnosis.next_capture)}")
    out.print(f"\nsession: {session_id}")
    out.print(f"report: {page}")


def _resolved(
    store: Store, station: Path | None, recordings: RecordingSet, fitted: FitResult, before: Diagnosis
) -> Diagnosis:
    """Take the best capture that the station can take by itself, and decide again with it; as it was where there is none."""
    from dataclasses import replace

    from lab.diagnose.outcome.next_capture import WORTH_TAKING
    from lab.formats.results import Resolution

    best = next((p for p in before.proposals if p.plan is not None and p.capture.distance >= WORTH_TAKING), None)
    if best is None:
        why = (
            "no capture that the station takes by itself tells the rivals apart"
            if before.proposals
            else "no rivals are left"
        )
        out.print(f"resolve: {why}")
        return before
    capture = best.capture
    out.print(escape(f"resolve: {capture.capture}, to tell {' from '.join(capture.rivals)}"))
    session_id = _captured(store, station, False, f"{recordings.manifest.name} resolve".strip(), "", best.plan)
    joined = recordings.joined(stored_recordings(store, session_id), "resolve")
    again = examined(joined, fitted)
    resolution = Resolution(
        capture=capture.capture,
        session=session_id,
        verdict_before=before.result.verdict,
        effects_before=before.result.effects,
    )
    return replace(again, result=again.result.model_copy(update={"resolution": resolution}))


def _captured(
    store: Store,
    station_file: Path | None,
    quick: bool,
    name: str,
    resume: str,
    calibration: Calibration | None = None,
) -> str:
    """Run a new session, or what is left of the session `resume`; its id. On the mock bench where there is no station."""
    from lab.capture.session import CaptureSession
    from lab.capture.session import Progress as Standing
    from lab.capture.station import read_station

    if resume and store.session(resume).state == "finished":
        return resume
    with contextlib.ExitStack() as stack:
        file = station_file or stack.enter_context(mock_bench())
        station = read_station(file)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        left = TextColumn("{task.fields[left]}")
        bar = stack.enter_context(Progress(*columns, left, console=err, transient=True, disable=not err.is_terminal))
        task = bar.add_task("capture", total=None, left="")
        begun: set[str] = set()

        def tell(standing: Standing) -> None:
            if not err.is_terminal and standing.sequence and standing.sequence not in begun:
                begun.add(standing.sequence)  # a log gets a line a sequence, where a person sees a bar
                out.print(f"{standing.sequence}: from step {standing.done + 1} of {standing.total}")
            left_s = "" if standing.left_s is None else f"about {standing.left_s:.0f} s left"
            what = escape(f"{standing.sequence} {standing.what}".strip())
            bar.update(task, description=what, total=standing.total, completed=standing.done, left=left_s)
            if standing.remark:
                err.print(f"calibench: {escape(standing.remark)}")

        if resume:
            session = CaptureSession(store, resume, on_progress=tell)
            session.station = station  # the instruments may have moved to other addresses
        else:
            session = CaptureSession.start(store, station, calibration, quick=quick, name=name, on_progress=tell)
        try:
            session.run()
        except KeyboardInterrupt:
            err.print(f"calibench: go on with `calibench capture --resume {session.id}`")
            raise
    return session.id
