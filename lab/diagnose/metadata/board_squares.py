"""A stated number of squares, or size of markers, that the frames of a board contradict."""

from __future__ import annotations

from typing import Any

from lab.capture_kinds.charuco import CharucoCapture
from lab.diagnose.measurements.boards import BOARDS
from lab.diagnose.metadata.misstatement import Misstatement
from lab.fit.geometry.board_detection import as_grey, luminance
from lab.fit.geometry.board_layout import BoardLayout, board_layout
from lab.formats.recording_set import RecordingSet
from sim.camera import Side

LOOKED_AT = 6  # most frames of a board that are used
FEWEST_PICTURES = 2
#: Tolerance of a marker's side, relative and absolute: detection finds a blurred dark marker up to 7 % too small.
MARKER_TOLERANCE, MARKER_PX = 0.15, 2.0


def misstated_board(recordings: RecordingSet, side: Side) -> Misstatement | None:
    """Boards whose frames fit another number of squares, or another ratio of marker to square, than stated; None where all fit.

    The length of a square can't be checked: a board twice as large at twice the distance gives the same image.
    """
    boards: dict[tuple[Any, ...], list[CharucoCapture]] = {}
    for capture in recordings.captures(CharucoCapture, side):
        boards.setdefault((capture.dictionary, capture.squares, capture.square_mm, capture.marker_mm), []).append(
            capture
        )
    cfa = recordings.camera(side).cfa
    lines: list[str] = []
    changed: dict[str, dict[str, Any]] = {}
    chi2, n = 0.0, 0
    for captures in boards.values():
        stated = captures[0]
        spread = captures[:: max(1, len(captures) // LOOKED_AT)][:LOOKED_AT]
        layout = board_layout([as_grey(luminance(recordings.frame(one), cfa)) for one in spread], stated)
        if layout is None or layout.pictures < FEWEST_PICTURES:
            continue
        update, told = _contradicted(stated, layout)
        if not update:
            continue
        lines += told
        changed |= {one.id: update for one in captures}
        off = layout.rms_stated / layout.rms if layout.rms and layout.rms_stated else 10.0
        chi2, n = chi2 + layout.pictures * max(off, 10.0) ** 2, n + layout.pictures
    if not changed:
        return None

    def restated(capture: Any) -> Any:
        return capture.model_copy(update=changed[capture.id]) if capture.id in changed else capture

    manifest = recordings.manifest
    captures_now = tuple(restated(one) for one in manifest.captures)
    return Misstatement(
        measurement=BOARDS,
        where="boards",
        shape="what is stated of a board contradicts its pictures",
        check=f"In the pictures of the {side} camera {'; '.join(lines)}. No picture tells the length of a square: square_mm stays as stated.",
        chi2_stated=chi2,
        chi2_corrected=float(n),
        n=n,
        captures=tuple(changed),
        corrected=recordings.under(manifest.model_copy(update={"captures": captures_now})),
    )


def _contradicted(stated: CharucoCapture, layout: BoardLayout) -> tuple[dict[str, Any], list[str]]:
    """The statements to correct, with the values that fit, and sentences about both."""
    update: dict[str, Any] = {}
    told = []
    same = layout.squares == stated.squares or (not stated.has_markers and layout.squares == stated.squares[::-1])
    if not same:
        update["squares"] = layout.squares
        (rows, cols), (rows_stated, cols_stated) = layout.squares, stated.squares
        told.append(
            f"a board has {rows} x {cols} squares and not {rows_stated} x {cols_stated}: correct squares to [{rows}, {cols}]"
        )
    if layout.marker_share is not None and layout.marker_px is not None and stated.marker_mm is not None:
        measured = layout.marker_share * stated.square_mm
        if abs(measured / stated.marker_mm - 1.0) > max(MARKER_TOLERANCE, MARKER_PX / layout.marker_px):
            update["marker_mm"] = round(measured, 2)
            told.append(
                f"markers are {100 * layout.marker_share:.0f} % of a square's side and not "
                f"{100 * stated.marker_mm / stated.square_mm:.0f} %: correct marker_mm to about {measured:.2g}, or square_mm"
            )
    return update, told
