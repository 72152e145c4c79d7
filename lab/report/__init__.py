"""Reports: one self-contained HTML page per calibration. No network: the charts' library is inlined once."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.diagnose.measurements.library import measurement_title
from lab.effect_titles import at_beginning, effect_title
from lab.errors import InputError
from lab.formats.raw_file import replacing
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    Check,
    DiagnosisResult,
    FitResult,
    KernelPair,
    ParameterValue,
    ResidualCurve,
    Skipped,
    ValidationResult,
)
from lab.formats.results.in_words import measured
from lab.report import answers, charts, geometry, words
from lab.report import diagnosis as diagnosis_page
from lab.report.chart_data import ChartData, plotly_base64
from lab.report.emva import data_sheets
from lab.report.figures import by_side, geometry_figures, stereo_figures
from lab.report.pictures import difference_picture, frame_picture, kernel_picture, patch_colours, trimmed_margin
from lab.report.provenance import Provenance, installed_versions, provenance_of
from lab.report.stills import still
from sim.camera import Side

__all__ = ["Provenance", "installed_versions", "provenance_of", "render_report", "write_report"]
KERNELS_A_SIDE = 12


@dataclass(frozen=True)
class _Kernel:
    """One measured kernel beside its prediction, as pictures."""

    label: str
    channel: str
    measured: str
    predicted: str
    difference: str
    limit: str
    psnr_peak: str
    psnr_unit: str

    @classmethod
    def of(cls, pair: KernelPair) -> _Kernel:
        measured_, predicted_ = np.asarray(pair.measured, float), np.asarray(pair.predicted, float)
        margin = trimmed_margin([measured_, predicted_])
        peak = float(predicted_.max())
        # at least 5 % of the peak, so that noise doesn't look like a difference
        limit = max(float(np.abs(measured_ - predicted_).max()), 0.05 * peak)
        return cls(
            label=pair.label,
            channel=pair.channel,
            measured=kernel_picture(measured_, peak, margin),
            predicted=kernel_picture(predicted_, peak, margin),
            difference=difference_picture(measured_ - predicted_, limit, margin),
            limit=f"{100 * limit / peak:.2g} %",
            psnr_peak=f"{pair.psnr_peak_db:.1f}",
            psnr_unit=f"{pair.psnr_unit_db:.1f}",
        )


def _without_repeats(recordings: RecordingSet, checks: list[Check]) -> list[Check]:
    """The first check of each edge: repeats of the same region at the same angle would only fill the page."""
    places = {capture.id: (capture.region, capture.angle_deg) for capture in recordings.captures(SlantedEdgeCapture)}
    first: dict[Any, Check] = {}
    for check in checks:
        first.setdefault(places.get(check.capture, check.capture), check)
    return list(first.values())


def _chart_item(recordings: RecordingSet, check: Check) -> dict[str, Any]:
    captures = [capture for capture in recordings.captures(ChartCapture, check.side) if capture.id == check.capture]
    photo = frame_picture(recordings.frame(captures[0]), recordings.camera(check.side)) if captures else None
    return {
        "capture": check.capture,
        "sentence": words.check_sentence(check),
        "photo": photo,
        "patches": [(name, *pair) for name, pair in patch_colours(check.patches).items()],
        "figure": charts.patch_comparison(check.patches),
    }


def _residuals(
    diagnosis: DiagnosisResult | None, sides: tuple[Side, ...]
) -> dict[Side, list[tuple[ResidualCurve, Any]]]:
    curves = diagnosis.curves if diagnosis is not None else ()
    return {
        side: [
            (curve, charts.residual_curve(curve))
            for curve in diagnosis_page.worst_of_each([curve for curve in curves if curve.side == side])
        ]
        for side in sides
    }


def _threshold_text(diagnosis: DiagnosisResult | None) -> str:
    if diagnosis is None or diagnosis.threshold is None:
        return ""
    rate = (
        f", at a false-alarm rate of {diagnosis.false_alarm_rate:.2g}" if diagnosis.false_alarm_rate is not None else ""
    )
    return f" (threshold {diagnosis.threshold:.1f} sigma{rate})"


def page_environment() -> jinja2.Environment:
    """The templates of the pages, with their filters."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )

    def parameter_value(value: ParameterValue) -> str:
        return measured(value.value, value.std, value.unit, value.interval)

    def stated(value: float | None, unit: str) -> str:
        return "" if value is None else measured(value, None, unit)

    environment.filters |= {
        "words": lambda text: str(text).replace("_", " "),
        "measurement": measurement_title,
        "effect_title": effect_title,
        "at_beginning": at_beginning,
        "parameter_name": words.parameter_name,
        "parameter_value": parameter_value,
        "stated": stated,
        "still": still,
        "mood": diagnosis_page.mood,
        "check_name": lambda name: words.CHECK_NAMES.get(name, name),
    }
    return environment


def render_report(
    recordings: RecordingSet,
    fit: FitResult,
    validation: ValidationResult | None,
    diagnosis: DiagnosisResult | None,
    provenance: Provenance,
) -> str:
    """The report as HTML text; see `write_report`."""
    sides = tuple(fit.cameras)
    checks = validation.checks if validation is not None else ()
    curves = diagnosis.curves if diagnosis is not None else ()
    rows = by_side(fit, recordings.manifest.cameras)
    skipped: dict[tuple[str, str, str], Skipped] = {}
    for result in (fit, validation, diagnosis):
        for item in result.skipped if result is not None else ():
            skipped.setdefault((item.step, item.side or "", item.reason), item)

    def of(side: Side, name: str) -> list[Check]:
        return [check for check in checks if check.side == side and check.name == name]

    noises = {side: camera.noise for side, camera in fit.cameras.items()}
    context: dict[str, Any] = {
        "title": recordings.manifest.name or Path(recordings.source).name,
        "version": metadata.version("calibench"),
        "source": recordings.source,
        "made": provenance.made.strftime("%Y-%m-%d %H:%M UTC"),
        "captures": len(recordings.captures()),
        "sides": sides,
        **answers.context(fit, validation, diagnosis, len(skipped), len(recordings.warnings)),
        "diagnosis": diagnosis,
        "threshold_text": _threshold_text(diagnosis),
        "mismatch_map": charts.mismatch_map(diagnosis) if diagnosis is not None else None,
        "held_out": charts.held_out_bars(diagnosis) if diagnosis is not None else None,
        "residuals": _residuals(diagnosis, sides),
        **diagnosis_page.context(diagnosis, sides),
        "rows": rows,
        "stated": any(figure.stated is not None for _, figures in rows for figure in figures.values()),
        "remarks": [
            (side, remark)
            for side, camera in fit.cameras.items()
            for part in (camera.noise, camera.spectral)
            for remark in (part.remarks if part else ())
        ],
        "transfer": {side: charts.photon_transfer(noise) if noise else None for side, noise in noises.items()},
        "sheets": list(data_sheets(recordings, fit)),
        "linearity": {side: charts.linearity(noise) if noise else None for side, noise in noises.items()},
        "qe": {
            side: charts.quantum_efficiency(camera.spectral, recordings, side)
            if camera.spectral and camera.spectral.quantum_efficiency
            else None
            for side, camera in fit.cameras.items()
        },
        "mtf_explained": {
            side: charts.transfer_overlays(
                charts.explained_overlays([curve for curve in curves if curve.side == side]), 2
            )
            for side in sides
        },
        "mtf": {
            side: charts.transfer_overlays(charts.validated_overlays(_without_repeats(recordings, of(side, "mtf"))))
            for side in sides
        },
        "kernels": {
            side: [_Kernel.of(pair) for check in of(side, "psf") for pair in check.kernels][:KERNELS_A_SIDE]
            for side in sides
        },
        "charts": {
            side: [_chart_item(recordings, check) for check in of(side, "colorchecker") if check.patches][:1]
            for side in sides
        },
        "stereo": list(stereo_figures(fit.stereo)) if fit.stereo else [],
        "pairs": fit.stereo.pairs if fit.stereo else 0,
        "pair": geometry.stereo_context(recordings, fit.stereo),
        "geometry_charts": geometry.charts_by_side({side: camera.geometry for side, camera in fit.cameras.items()}),
        "geometry": {
            side: {"figures": list(geometry_figures(camera.geometry)), "views": camera.geometry.views}
            | geometry.context(camera.geometry)
            if camera.geometry
            else None
            for side, camera in fit.cameras.items()
        },
        "checks": checks,
        "skipped": list(skipped.values()),
        "warnings": recordings.warnings,
        "provenance": provenance,
        "notes": recordings.manifest.notes,
        "listed": recordings.captures(),
        "chart_data": ChartData(),
        "plotly": plotly_base64(),
    }
    return page_environment().get_template("page.html").render(context)


def write_report(
    out: str | os.PathLike[str],
    recordings: RecordingSet,
    fit: FitResult,
    validation: ValidationResult | None,
    diagnosis: DiagnosisResult | None,
    provenance: Provenance | None = None,
) -> Path:
    """Write the report as the file `out`, one self-contained page: completely, or not at all.

    `validation` and `diagnosis` may be None: the page says that they were not done. `provenance`: by default, what the
    recordings themselves tell. Raises InputError where the file can't be written.
    """
    file = Path(out)
    page = render_report(recordings, fit, validation, diagnosis, provenance or provenance_of(recordings))
    return write_page(file, page)


def write_page(file: Path, page: str) -> Path:
    """Write a page completely, or not at all. Raises InputError where it can't be written."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as partial:
            partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file}: can't be written ({error.strerror}); name a place that is yours") from error
    return file
