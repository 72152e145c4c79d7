"""`calibench twin`: predictions before the capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.capture.data_folder import existing_store
from lab.cli.console import check_writable, out, write_json
from lab.cli.sources import Json, StoreFolder, camera_path, recordings_of
from lab.errors import InputError

if TYPE_CHECKING:
    from lab.formats.camera_file import CameraFile
    from lab.formats.recording_set import RecordingSet
    from lab.twin.score import TwinScore
    from sim.camera import Side

commands = typer.Typer(name="twin", help="Predict a session before it is captured, and open the prediction against it.")


@commands.command()
def predict(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="a camera file, or a folder of SIDE.toml")],
    plan: Annotated[
        str, typer.Option("--plan", metavar="PLAN", help="a recording set whose captures are planned again")
    ],
    out_file: Annotated[
        Path, typer.Option("--out", metavar="SEALED", help="the sealed prediction; its hash is written beside it")
    ],
    change: Annotated[
        str,
        typer.Option(
            "--change",
            metavar="KEY=VALUE,...",
            help="f_number, temperature_c, lamp, lens, distance_mm, exposure_factor, gain_db, radiance_factor",
        ),
    ] = "",
    fitted: Annotated[
        str | None,
        typer.Option(
            "--fitted",
            metavar="SET",
            help="the recordings of the fit: levels of flats are predicted relative to theirs",
        ),
    ] = None,
    light_std_percent: Annotated[float, typer.Option(help="standard deviation of the light to come, per cent")] = 0.3,
    data: StoreFolder = None,
) -> None:
    """Predict the measured numbers of a session that hasn't been captured, with their covariance, and seal them by
    hash.

    Example: calibench twin predict camera.toml --plan my-camera --change f_number=8 --out f8.json
    """
    from lab.twin.changes import parse_changes
    from lab.twin.predict import predict as predicted
    from lab.twin.sealed import seal

    changes = parse_changes(change)
    changes.spectrum()
    check_writable(out_file)
    if not model.exists():
        raise InputError(f"{model}: isn't there; name a camera file, or the folder of `diagnose --save`")
    recordings = recordings_of(plan, data)
    prediction = predicted(
        _models(recordings, model), recordings, changes, model=str(model), light_std=light_std_percent / 100.0,
        fitted=None if fitted is None else recordings_of(fitted, data),
    )  # fmt: skip
    hashed = seal(prediction, out_file)
    for side, sealed_side in prediction.sides.items():
        for skipped in sealed_side.skipped:
            out.print(escape(f"{side}: not predicted: {skipped.reason}"))
        out.print(escape(f"{side}: {len(sealed_side.numbers)} numbers predicted"))
    out.print(escape(f"sealed: {out_file}, SHA-256 {hashed}"))


def _models(recordings: RecordingSet, path: Path) -> dict[Side, CameraFile]:
    """The cameras of a file, or of those SIDE.toml that a folder has."""
    from lab.formats.camera_file import read_camera

    files = {side: camera_path(recordings, side, path) for side in recordings.sides}
    there = {side: file for side, file in files.items() if file.is_file()}
    if not there:
        raise InputError(
            f"{path}: has no {' or '.join(f'{s}.toml' for s in files)}; name the folder of `diagnose --save`"
        )
    return {side: read_camera(file) for side, file in there.items()}


@commands.command()
def score(
    sealed: Annotated[Path, typer.Argument(metavar="SEALED", help="a sealed prediction")],
    source: Annotated[
        str, typer.Argument(metavar="SET", help="the session that was predicted: a recording set or a stored session")
    ],
    json: Json = None,
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", metavar="HASH", help="the hash, in place of that in the file SEALED.sha256"),
    ] = None,
    data: StoreFolder = None,
) -> None:
    """Open a sealed prediction against the recordings: deviations, intervals, and effects that it contradicts.

    Example: calibench twin score f8.json session-at-f8
    """
    from lab.twin.score import score as scored
    from lab.twin.sealed import open_seal

    check_writable(json)
    prediction = open_seal(sealed, sha256)
    score = scored(prediction, recordings_of(source, data))
    write_json(score, json)
    if str(json) != "-":
        _print(score)


def _print(score: TwinScore) -> None:
    from lab.twin.score import conclusion, title

    table = Table(box=None, pad_edge=False)
    for heading in ("quantity", "n", "median", "95 % of all within", "in 95 % intervals", "chi2 / n"):
        table.add_column(heading, justify="left" if heading == "quantity" else "right")
    for quantity in score.quantities:
        unit = " %" if quantity.unit == "%" else ""
        table.add_row(
            title(quantity.quantity), str(quantity.n),
            f"{quantity.median:.3g}{unit}", f"{quantity.largest_of_95_percent:.3g}{unit}",
            f"{100 * quantity.within_95_percent_interval:.1f} %", f"{quantity.chi2 / quantity.n:.2f}",
        )  # fmt: skip
    out.print(table)
    out.print(f"chi2 {score.chi2:.1f} of {score.n} numbers; {score.missing} predicted numbers weren't measured")
    for effect in score.effects:
        out.print(escape(f"{effect.side}: {effect.words}"))
    for side in dict.fromkeys(effect.side for effect in score.effects):
        out.print(escape(f"{side}, after this session: {conclusion([e for e in score.effects if e.side == side])}"))


@commands.command()
def budget(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="a camera file")],
    use: Annotated[str, typer.Option("--use", metavar="USE,...", help="MTF50, patches, variance, dark mean")],
    station: Annotated[
        Path | None,
        typer.Option("--station", metavar="FILE", help="rank this station's sequences by error reduced for a minute"),
    ] = None,
    json: Json = None,
    data: StoreFolder = None,
) -> None:
    """List the contributions of effects and parameters to the variance of an application, and the sequences of a
    station by the reduction of that variance per minute of lab time.

    Example: calibench twin budget camera.toml --use mtf
    """
    from lab.capture.catalogue import step_times
    from lab.capture.station import read_station
    from lab.formats.camera_file import read_camera
    from lab.twin.budget import budget as budgeted
    from lab.twin.budget import parse_uses

    uses = parse_uses(use)
    check_writable(json)
    there = None if station is None else read_station(station)
    store = None if there is None else existing_store(data)
    times = None if there is None or store is None else step_times(store, there)
    budgets = budgeted(read_camera(model), uses, there, times)
    write_json(budgets, json)
    if str(json) == "-":
        return
    for budget in budgets.uses:
        out.print(escape(f"{budget.use}: standard deviation {budget.std_percent:.3g} %"))
        table = Table(box=None, pad_edge=False)
        for heading in ("what", "share of the variance", "alone"):
            table.add_column(heading, justify="left" if heading == "what" else "right")
        for part in budget.contributions:
            table.add_row(escape(part.name), f"{part.share_percent:.1f} %", f"{part.std_percent:.3g} %")
        out.print(table)
        if not budget.captures:
            continue
        table = Table(box=None, pad_edge=False)
        for heading in ("sequence", "minutes", "then", "less for a minute"):
            table.add_column(heading, justify="left" if heading == "sequence" else "right")
        for gain in budget.captures:
            about = "" if gain.is_learned else "about "
            table.add_row(
                escape(gain.sequence), f"{about}{gain.minutes:.1f}", f"{gain.std_percent:.3g} %",
                f"{gain.reduced_percent_per_minute:.2g} %",
            )  # fmt: skip
        out.print(table)
