"""Photon transfer beyond where it was fitted: `python -m benchmarks.real.extrapolation --data FOLDER`.

Of each set with flats at several levels, the lowest 60 % of the levels are fitted and diagnosed, the rest is predicted
and sealed before it is opened: mean and temporal variance of every flat, and the darks of other exposures.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from evaluation.page import placed
from lab.capture_kinds.base import Capture
from lab.capture_kinds.dark import DarkCapture
from lab.capture_kinds.flat import FlatCapture
from lab.diagnose import examine
from lab.errors import InputError
from lab.fit import fit_recording_set
from lab.foreign_recordings import read_foreign
from lab.formats.importers import ImportOptions
from lab.formats.recording_set import RecordingSet, read
from lab.twin.changes import Changes
from lab.twin.predict import predict
from lab.twin.score import QuantityScore, TwinScore, score, title
from lab.twin.sealed import open_seal, seal
from sim.parameters import Frozen

#: Sets of the shared data, and how each is imported; empty: a recording set.
SETS = {
    "emva1288_ccd": "emva1288",
    "emva1288_cmos_crop": "emva1288",
    "emva1288_simulated_crop": "emva1288",
    "foreign_healthy": "",
}
FITTED_SHARE = 0.6


class Extrapolation(Frozen):
    """One set: how many levels were fitted and predicted, what was named in the fitted part, and the rest's score."""

    name: str
    fitted: int
    predicted: int
    named: tuple[str, ...]
    quantities: tuple[QuantityScore, ...]
    effects: tuple[str, ...]


def split(recordings: RecordingSet) -> tuple[RecordingSet, RecordingSet, int, int]:
    """The lowest levels of the flats with the darks of their exposures; all other flats and darks; and how many levels
    each holds."""
    flats = recordings.captures(FlatCapture, "left")
    dose = {c.id: (c.photons_per_pixel if c.photons_per_pixel is not None else c.exposure_s) for c in flats}
    levels = sorted(set(dose.values()))
    count = round(FITTED_SHARE * len(levels))
    low = {c.id for c in flats if dose[c.id] <= levels[count - 1]}
    exposures = {c.exposure_s for c in flats if c.id in low}
    darks: list[DarkCapture] = recordings.captures(DarkCapture, "left")
    with_flats = {c.exposure_s for c in flats} & {c.exposure_s for c in darks}
    late = {c.id for c in darks if c.exposure_s in with_flats - exposures}  # those of the levels to come
    late |= {c.id for c in flats if c.id not in low}

    def part(is_late: bool) -> RecordingSet:
        of_part: list[Capture] = [
            c
            for c in recordings.captures(side="left")
            if (c.id in late) == is_late and (not is_late or isinstance(c, FlatCapture | DarkCapture))
        ]
        return recordings.under(recordings.manifest.model_copy(update={"captures": tuple(of_part)}))

    return part(False), part(True), count, len(levels) - count


def extrapolate(name: str, recordings: RecordingSet, folder: Path) -> Extrapolation:
    """Fit, predict, seal, open. `folder` holds the sealed prediction."""
    fitted, rest, low, high = split(recordings)
    fit = fit_recording_set(fitted)
    found = examine(fitted, fit, at_once=False)
    sealed = folder / f"{name}.json"
    seal(predict(found.improved, rest, Changes(), model=name, fitted=fitted), sealed)
    result: TwinScore = score(open_seal(sealed), rest)
    return Extrapolation(
        name=name, fitted=low, predicted=high, named=tuple(e.name for e in found.result.effects),
        quantities=result.quantities, effects=tuple(f"{e.name}: {e.verdict}" for e in result.effects),
    )  # fmt: skip


def section(found: list[Extrapolation]) -> str:
    """The section of the page, Markdown."""
    lines = [
        "| set | levels fitted, predicted | quantity | n | median | 95 % within | in 95 % intervals | chi2 / n |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in found:
        for q in one.quantities:
            lines.append(
                f"| {one.name} | {one.fitted}, {one.predicted} | {title(q.quantity)} | {q.n} | {q.median:.3g} % | "
                f"{q.largest_of_95_percent:.3g} % | {100 * q.within_95_percent_interval:.0f} % | {q.chi2 / q.n:.2f} |"
            )
    for one in found:
        lines.append(f"\n{one.name}: named in the lowest levels: {', '.join(one.named) or 'nothing'}.")
        if one.effects:
            lines[-1] += f" Of these, in the highest: {', '.join(one.effects)}."
    return "\n".join(lines)


def main(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="the folder of the sets")],
    only: Annotated[list[str] | None, typer.Option("--only", metavar="SET", help="this set; may be repeated")] = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE.md", help="write the table into this page")
    ] = None,
) -> None:
    """Predict the highest levels of real photon-transfer sets from the lowest 60 %."""
    unknown = sorted(set(only or ()) - set(SETS))
    if unknown:
        raise InputError(f"--only {unknown[0]}: no such set; there are {', '.join(SETS)}")
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, kind in SETS.items():
            if only and name not in only:
                continue
            path = data / name
            recordings = read_foreign(kind, path, ImportOptions()) if kind else read(path)
            found.append(extrapolate(name, recordings, Path(scratch)))
            print(f"{name}: {found[-1].named or 'nothing named'}", flush=True)
    print(section(found))
    if page is not None:
        text = page.read_text(encoding="utf-8") if page.is_file() else "# Proof of the twin\n"
        page.write_text(placed(text, "extrapolation", section(found)), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
