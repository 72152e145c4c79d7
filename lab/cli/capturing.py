"""`calibench capture` and `calibench run`."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from lab.bench_process import mock_bench
from lab.capture.data_folder import open_store, store_to_read
from lab.cli.console import check_writable, err, make_folder, out, write_json
from lab.cli.sources import EngineName, Json, StoreFolder, recordings_of, run_here
from lab.cli.tables import print_fit, print_resolving, print_sequences
from lab.engine import DEFAULT_ENGINE
from lab.errors import InputError
from lab.pipeline import CaptureRequest, PipelineRequest, PipelineResult, capture_here, session_recordings

if TYPE_CHECKING:
    from lab.capture.session import Progress as CaptureProgress
    from lab.capture.store import Store
    from lab.resolve import ResolveLimits

commands = typer.Typer()

StationFile = Annotated[
    Path | None, typer.Option("--station", metavar="FILE", help="the station file; without one, the mock bench")
]
Quick = Annotated[bool, typer.Option("--quick", help="fewer exposures and repeats")]
DataFolder = Annotated[
    Path | None,
    typer.Option("--out", "--data", metavar="DIR", help="the data folder (CALIBENCH_DATA, else calibench-data)"),
]
Name = Annotated[str, typer.Option(help="name of the session")]
Resume = Annotated[str, typer.Option(metavar="SESSION", help="resume this session")]
Only = Annotated[
    list[str] | None,
    typer.Option(metavar="SEQUENCE", help="take this sequence only (dark, flat, ...); may be repeated"),
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SEQUENCE.PARAMETER=VALUE[,VALUE]",
        help="another value of a sequence's parameter, as `calibench sequences` lists them; may be repeated",
    ),
]
Certified = Annotated[
    bool, typer.Option("--certified", help="refuse cameras without a certified calibration that isn't expired")
]
Conceal = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SIDE:EFFECT:PARAMETER=VALUE[,PARAMETER=VALUE]",
        help="an effect that the mock bench conceals; may be repeated",
    ),
]


@commands.command()
def capture(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Name = "",
    resume: Resume = "",
    only: Only = None,
    parameters: Set = None,
    certified: Certified = False,
    conceal: Conceal = None,
) -> None:
    """Run the sequences of a station and store the captures. Without a station file: on the mock bench.

    Example: calibench capture --station lab.toml --only dark --only flat
    """
    from lab.capture.catalogue import parse_parameters

    store = open_store(out_folder)
    request = PipelineRequest(
        "capture",
        capture=CaptureRequest(
            session=resume,
            quick=quick,
            only=tuple(only or ()),
            parameters=parse_parameters(parameters or ()),
            name=name,
            demands_certified=certified,
        ),
    )
    out.print(f"session: {_carry_out(request, store, station, conceal, ['capture']).session}")


@commands.command()
def run(
    station: StationFile = None,
    quick: Quick = False,
    out_folder: DataFolder = None,
    name: Name = "",
    resume: Resume = "",
    resolve: Annotated[
        bool,
        typer.Option(
            "--resolve", help="while rivals are left, take the capture that tells them apart and diagnose again"
        ),
    ] = False,
    resolve_minutes: Annotated[
        float | None,
        typer.Option(
            "--resolve-minutes", metavar="MIN", help="with --resolve: lab time that its captures may take (else any)"
        ),
    ] = None,
    resolve_rounds: Annotated[
        int | None,
        typer.Option("--resolve-rounds", metavar="N", help="with --resolve: captures that it takes at most (else 6)"),
    ] = None,
    recordings: Annotated[
        str,
        typer.Option(
            "--recordings",
            metavar="SOURCE",
            help="with --resolve and --station: resolve the rivals of these, a recording set's folder or a stored "
            "session's id, by captures of the station that made them",
        ),
    ] = "",
    only: Only = None,
    parameters: Set = None,
    engine: EngineName = DEFAULT_ENGINE,
    conceal: Conceal = None,
    standards: Annotated[
        bool,
        typer.Option(
            "--standards",
            help="capture what EMVA 1288, ISO 12233 and other standards ask for, and report their figures instead",
        ),
    ] = False,
) -> None:
    """The main job: capture, fit, validate, diagnose, report. Without a station file: on the mock bench.

    Example: calibench run --quick --out results
    """
    from lab.capture.catalogue import parse_parameters
    from lab.report import words
    from lab.report.answers import answers
    from lab.resolve import resolve_limits

    limits = resolve_limits(resolve, resolve_minutes, resolve_rounds)
    store = open_store(out_folder)
    if standards:
        if limits is not None or recordings or only or parameters:
            raise InputError(
                "--standards: takes its own sequences and no diagnosis; leave --resolve, --recordings, --only and "
                "--set out, or take `calibench standards SESSION` on other captures"
            )
        wanted = CaptureRequest(session=resume, quick=quick, name=name, standards=True)
        _report_session(store, station, conceal, PipelineRequest("capture", capture=wanted))
        return
    if recordings:
        if station is None or limits is None:
            raise InputError(
                "--recordings: are settled by captures of the station that made them; give --station and --resolve, or "
                "take `calibench report`"
            )
        if quick or name or resume or only or parameters or conceal:
            raise InputError(
                "--recordings: were captured already; leave --quick, --name, --resume, --only, --set and --conceal out"
            )
        request = _request_to_resolve(recordings, station, limits, out_folder)
    else:
        session = CaptureRequest(
            session=resume,
            quick=quick,
            only=tuple(only or ()),
            parameters=parse_parameters(parameters or ()),
            name=name,
        )
        request = PipelineRequest("pipeline", capture=session, resolve=limits)
    request = replace(request, engine=engine)
    verb = ["run"]  # what goes on then fits and diagnoses, too
    verb += [] if engine == DEFAULT_ENGINE else [f"--engine={engine}"]
    verb += ["--resolve"] if resolve else []
    verb += [] if resolve_minutes is None else [f"--resolve-minutes={resolve_minutes:g}"]
    verb += [] if resolve_rounds is None else [f"--resolve-rounds={resolve_rounds}"]
    result = _carry_out(request, store, station, conceal, verb)
    assert result.fit is not None
    assert result.validation is not None
    assert result.diagnosis is not None
    print_fit(result.recordings, result.fit)
    badge, _, headline = words.headline(result.diagnosis)
    out.print(f"\n[bold]{badge}[/]: {headline}")
    for question, lines in answers(result.fit, result.validation, result.diagnosis):
        out.print(f"[bold]{question}[/]" if lines else "")
        for line in lines:
            out.print(escape(line))
    print_resolving(result.diagnosis)
    out.print("" if result.session is None else f"\nsession: {result.session}")
    out.print(f"report: {result.report}")


def _report_session(store: Store, station: Path | None, conceal: list[str] | None, request: PipelineRequest) -> None:
    """Capture a session for the standards, and write their pages, their PDF where matplotlib is installed, and their
    JSON into its folder."""
    from lab.cli.standards import report_standards
    from lab.report.standards_pdf import has_matplotlib

    session = _carry_out(request, store, station, conceal, ["run", "--standards"]).session
    assert session is not None
    recordings = session_recordings(store, session)
    fitted = run_here(PipelineRequest("fit", recordings=recordings, source=session), store).fit
    assert fitted is not None
    folder = store.folder(session) / "standards"
    make_folder(folder)
    with_pdf = has_matplotlib()
    report_standards(
        recordings, fitted, folder / "standards.json", folder, folder / "standards.pdf" if with_pdf else None
    )
    if not with_pdf:
        err.print("pdf: none: matplotlib isn't installed; pip install 'calibench[pdf]'")
    out.print(f"\nsession: {session}")


def _request_to_resolve(source: str, station_file: Path, limits: ResolveLimits, data: Path | None) -> PipelineRequest:
    """Return the request that resolves the rivals of recordings on the station that made them. Raises InputError where
    the station is another one."""
    from lab.capture.station import read_station
    from lab.resolve import station_of

    station = read_station(station_file)
    recordings = recordings_of(source, data)
    return PipelineRequest("pipeline", recordings=recordings, resolve=limits, station=station_of(recordings, station))


@commands.command()
def sequences(
    station: Annotated[
        Path | None, typer.Option("--station", metavar="FILE", help="what they take on this station: captures and time")
    ] = None,
    quick: Quick = False,
    only: Only = None,
    parameters: Set = None,
    json: Json = None,
    data: StoreFolder = None,
) -> None:
    """The sequences: what each is for, its parameters with unit and bounds; with a station file, their values, captures
    and time there.

    Example: calibench sequences --station lab.toml
    """
    from lab.capture.catalogue import catalogue, estimate, parse_parameters, step_times
    from lab.capture.plan import full_plan
    from lab.capture.station import read_station

    check_writable(json)
    if station is None and (quick or only or parameters):
        raise InputError("--quick, --only, --set: go with a station file; give --station")
    expected = None
    if station is not None:
        there = read_station(station)
        plan = full_plan(there, quick, only, parse_parameters(parameters or ()))
        expected = estimate(plan, there, step_times(open_store(data), there))
        write_json(expected, json)
    elif json is not None:
        raise InputError("--json: writes what the sequences take on a station; give --station")
    if str(json) != "-":
        print_sequences(catalogue(), expected)


@commands.command("put-back")
def put_back(
    session: Annotated[
        str, typer.Argument(metavar="SESSION", help="say that what this session left changed is put back")
    ] = "",
    data: StoreFolder = None,
) -> None:
    """What sessions that ended early left changed by hand, and how to put it back; with SESSION: it is put back.

    Example: calibench put-back 20261127-101500-7f3ad2
    """
    from lab.capture.by_hand import left_by_hand, note_put_back

    root = store_to_read(data).root
    left = {change.session: change for change in left_by_hand(root)}
    if session and session not in left:
        known = f"; those are {', '.join(left)}" if left else "; nothing is"
        raise InputError(f"session {session}: left nothing changed by hand{known}")
    if session:
        note_put_back(root, session)
        out.print(f"session {escape(session)}: put back")
        return
    for change in left.values():
        out.print(f"session {escape(change.session)}: {escape(change.words)}")
    if not left:
        out.print("nothing is left changed by hand")


@commands.command("confirm")
def confirm_step(
    session: Annotated[str, typer.Argument(metavar="SESSION", help="the session that waits")] = "",
    target: Annotated[str, typer.Argument(metavar="TARGET", help="what is there now, by the name it is asked by")] = "",
    data: StoreFolder = None,
) -> None:
    """What sessions that the service runs wait for an operator to do; with SESSION and TARGET: it is done.

    Example: calibench confirm 20261127-101500-7f3ad2 board-at-2-m
    """
    from lab.capture.questions import confirm, question_of

    store = store_to_read(data)
    if session:
        store.session(session)
        if not target:
            raise InputError(f"session {session}: give the target, too, as `calibench confirm` lists it")
        confirm(store, session, target, "the command line")
        out.print(f"session {escape(session)}: {escape(target)} is there")
        return
    asked = {
        session_id: question
        for session_id in store.under_way()
        if (question := question_of(store, session_id)) is not None
    }
    for waiting, question in asked.items():
        since = f"{question.since:%Y-%m-%d %H:%M:%S} UTC"
        out.print(
            f"session {escape(waiting)}: {escape(question.target)}: {escape(question.instruction)} (since {since})"
        )
    if not asked:
        out.print("no session waits for an operator")


def _carry_out(
    request: PipelineRequest, store: Store, station_file: Path | None, conceal: list[str] | None, verb: list[str]
) -> PipelineResult:
    """Carry out a request in this thread, with captures on the station of a file, or on a mock bench that is started
    for each session. Where it is interrupted, tells the command that goes on; `verb`: its first words."""
    if station_file is not None and conceal:
        raise InputError("--conceal: only the mock bench conceals effects; leave --station out")
    from lab.capture.by_hand import left_by_session

    captured_here: dict[str, None] = {}
    session = "" if request.capture is None else request.capture.session

    def captured(wanted: CaptureRequest, tell: Callable[[CaptureProgress], None]) -> str:
        from lab.capture.station import read_station

        def told(progress: CaptureProgress) -> None:
            nonlocal session
            captured_here[progress.session] = None
            session = session or progress.session  # the first: later ones resolve its doubts
            tell(progress)

        if request.station is not None:
            return capture_here(store, request.station, wanted, told)
        with contextlib.nullcontext(station_file) if station_file else mock_bench(conceal or []) as file:
            return capture_here(store, read_station(file), wanted, told)

    try:
        return run_here(request, store, captured)
    except BaseException as error:
        for left in filter(None, (left_by_session(store.root, session_id) for session_id in captured_here)):
            err.print(f"calibench: session {escape(left.session)}: {escape(left.words)}")
        if request.capture is None and isinstance(error, KeyboardInterrupt):
            err.print("calibench: the same command goes on where it was")
        elif session and isinstance(error, KeyboardInterrupt):
            command = _resuming(verb, session, store, station_file, conceal or [])
            err.print(f"calibench: go on with `{escape(command)}`")
        raise


def _resuming(verb: list[str], session: str, store: Store, station_file: Path | None, conceal: list[str]) -> str:
    """The command that resumes a session where it was captured."""
    words = ["calibench", *verb, "--resume", session, "--out", str(store.root)]
    words += [] if station_file is None else ["--station", str(station_file)]
    return shlex.join([*words, *(f"--conceal={item}" for item in conceal)])
