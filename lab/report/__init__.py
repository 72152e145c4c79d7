"""Reports: one self-contained HTML page per calibration. No network: the charts' library is inlined once."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from lab.calibration.limits import CalibrationLimits, figures_of, judge_figures
from lab.capture_kinds.chart import ChartCapture
from lab.capture_kinds.slanted_edge import SlantedEdgeCapture
from lab.effect_titles import at_beginning, effect_title
from lab.errors import cannot_write
from lab.formats.raw_file import replacing
from lab.formats.recording_set import RecordingSet
from lab.formats.recording_set.manifest import format_setting
from lab.formats.result_file import Provenance, installed_versions, provenance_of
from lab.formats.results import (
    Check,
    DiagnosisResult,
    FitResult,
    KernelPair,
    ResidualCurve,
    Skipped,
    ValidationResult,
)
from lab.formats.results.words import format_value
from lab.observables.observable import measurement_title
from lab.predict.validate import BothModels
from lab.report import answers, charts, geometry, words
from lab.report import diagnosis as diagnosis_page
from lab.report.charts import ChartData, plotly_base64
from lab.report.emva import data_sheets
from lab.report.figures import by_side, geometry_figures, stereo_figures
from lab.report.pictures import difference_picture, frame_picture, kernel_picture, patch_colours, trim_margin
from lab.report.stills import still
from sim.camera import Side

__all__ = ["Provenance", "installed_versions", "provenance_of", "render_report", "write_report"]
KERNELS_A_SIDE = 12
DRIFTS_A_SIDE = 6  # the most significant of each kind come first


@dataclass(frozen=True)
class _Prediction:
    """One model's kernel and its difference from the measured one, as pictures."""

    model: str
    picture: str
    difference: str
    psnr: str


@dataclass(frozen=True)
class _Kernel:
    """One measured kernel beside its predictions, as pictures. `limit`: of the differences' colours, of the peak."""

    label: str
    channel: str
    measured: str
    predictions: tuple[_Prediction, ...]
    limit: str

    @classmethod
    def of(cls, pairs: dict[str, KernelPair]) -> _Kernel:
        """Draw one kernel; `pairs`: by the name of the model that predicts it."""
        first = next(iter(pairs.values()))
        seen = np.asarray(first.measured, float)
        predicted = {model: np.asarray(pair.predicted, float) for model, pair in pairs.items()}
        margin = trim_margin([seen, *predicted.values()])
        peak = max(float(kernel.max()) for kernel in predicted.values())
        # at least 5 % of the peak, so that noise doesn't look like a difference
        limit = max(*(float(np.abs(seen - kernel).max()) for kernel in predicted.values()), 0.05 * peak)
        return cls(
            label=first.label,
            channel=first.channel,
            measured=kernel_picture(seen, peak, margin),
            predictions=tuple(
                _Prediction(
                    model=model,
                    picture=kernel_picture(kernel, peak, margin),
                    difference=difference_picture(seen - kernel, limit, margin),
                    psnr=f"{pairs[model].psnr_peak_db:.1f} dB",
                )
                for model, kernel in predicted.items()
            ),
            limit=f"{100 * limit / peak:.2g} %",
        )


def _without_repeats(recordings: RecordingSet, checks: list[Check]) -> list[Check]:
    """Return the first check of each edge: repeats of the same region at the same angle would only fill the page."""
    places = {capture.id: (capture.region, capture.angle_deg) for capture in recordings.captures(SlantedEdgeCapture)}
    first: dict[Any, Check] = {}
    for check in checks:
        first.setdefault(places.get(check.capture, check.capture), check)
    return list(first.values())


def _chart_item(recordings: RecordingSet, check: Check, improved: Check | None) -> dict[str, Any]:
    captures = [capture for capture in recordings.captures(ChartCapture, check.side) if capture.id == check.capture]
    photo = frame_picture(recordings.frame(captures[0]), recordings.camera(check.side)) if captures else None
    best = improved or check
    return {
        "capture": check.capture,
        "photo": photo,
        "patches": [(name, *pair) for name, pair in patch_colours(best.patches).items()],
        "figure": charts.patch_comparison(check.patches, improved.patches if improved else None),
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
    """Return the templates of the pages, with their filters."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )

    def format_stated(value: float | None, unit: str) -> str:
        return "" if value is None else format_value(value, None, unit)

    environment.filters |= {
        "words": lambda text: str(text).replace("_", " "),
        "measurement": measurement_title,
        "effect_title": effect_title,
        "at_beginning": at_beginning,
        "parameter_name": words.parameter_name,
        "parameter_value": words.parameter_value,
        "stated": format_stated,
        "stated_as": lambda value, std, unit: "–" if value is None else format_value(value, std, unit),
        "still": still,
        "setting": format_setting,
        "mood": diagnosis_page.mood,
    }
    return environment


def render_report(
    recordings: RecordingSet,
    fit: FitResult,
    validation: ValidationResult | None,
    diagnosis: DiagnosisResult | None,
    provenance: Provenance,
    both: BothModels | None = None,
    limits: CalibrationLimits | None = None,
) -> str:
    """Return the report as HTML text; see `write_report`."""
    sides = tuple(fit.cameras)
    fitted_checks = validation.checks if validation is not None else ()
    checks = both.baseline if both is not None else fitted_checks
    by_improved = (
        {(check.name, check.side, check.capture): check for check in both.improved} if both is not None else {}
    )
    model = "baseline" if both is not None else words.FITTED
    curves = diagnosis.curves if diagnosis is not None else ()
    rows = by_side(fit, recordings.manifest.cameras)
    skipped: dict[tuple[str, str, str], Skipped] = {}
    for result in (fit, validation, diagnosis):
        for item in result.skipped if result is not None else ():
            skipped.setdefault((item.step, item.side or "", item.reason), item)

    def of(side: Side, name: str) -> list[Check]:
        return [check for check in checks if check.side == side and check.name == name]

    def after(check: Check) -> Check | None:
        return by_improved.get((check.name, check.side, check.capture))

    noises = {side: camera.noise for side, camera in fit.cameras.items()}
    context: dict[str, Any] = {
        "title": recordings.manifest.name or Path(recordings.source).name,
        "version": metadata.version("calibench"),
        "source": recordings.source,
        "made": provenance.made.strftime("%Y-%m-%d %H:%M UTC"),
        "captures": len(recordings.captures()),
        "sides": sides,
        **answers.context(fit, validation, diagnosis, len(skipped), len(recordings.warnings), both),
        "diagnosis": diagnosis,
        "threshold_text": _threshold_text(diagnosis),
        "mismatch_map": charts.mismatch_map(diagnosis) if diagnosis is not None else None,
        "held_out": charts.held_out_bars(diagnosis) if diagnosis is not None else None,
        "residuals": _residuals(diagnosis, sides),
        **diagnosis_page.context(diagnosis, sides),
        "rows": rows,
        "stated": any(figure.stated is not None for _, figures in rows for figure in figures.values()),
        "implausible": fit.warnings,
        "remarks": [
            (side, remark)
            for side, camera in fit.cameras.items()
            for remark in camera.remarks
            if camera.geometry is None or remark not in camera.geometry.remarks  # these stand beside the geometry
        ],
        "drifts": [
            (side, drift, charts.repeat_drift(drift))
            for side, camera in fit.cameras.items()
            for drift in camera.repeat_drifts[:DRIFTS_A_SIDE]
        ],
        "transfer": {side: charts.photon_transfer(noise) if noise else None for side, noise in noises.items()},
        "sheets": list(data_sheets(recordings, fit)),
        "linearity": {side: charts.linearity(noise) if noise else None for side, noise in noises.items()},
        "qe": {
            side: charts.quantum_efficiency(
                camera.spectral, recordings, side, both.sensitivity.get(side) if both else None
            )
            if camera.spectral and camera.spectral.quantum_efficiency
            else None
            for side, camera in fit.cameras.items()
        },
        "mtf_explained": {
            side: charts.transfer_overlays(
                charts.overlay_explained([curve for curve in curves if curve.side == side]), 2
            )
            for side in sides
        }
        if both is None
        else {},
        "mtf": {
            side: charts.transfer_overlays(
                charts.overlay_validated(
                    [(check, after(check)) for check in _without_repeats(recordings, of(side, "mtf"))]
                ),
                model=model,
            )
            for side in sides
        },
        "kernels": {
            side: [
                _Kernel.of({model: pair} | ({"improved model": improved_pair} if improved_pair else {}))
                for check in of(side, "psf")
                for mended in (after(check),)
                for pair, improved_pair in zip(
                    check.kernels, mended.kernels if mended else (None,) * len(check.kernels), strict=True
                )
            ][:KERNELS_A_SIDE]
            for side in sides
        },
        "charts": {
            side: [_chart_item(recordings, check, after(check)) for check in of(side, "colorchecker") if check.patches][
                :1
            ]
            for side in sides
        },
        "compared": words.compare_checks(both.baseline if both else (), tuple(by_improved.values()), fitted_checks),
        "models": words.models(both is not None, bool(by_improved)),
        "judgements": judge_figures(figures_of(fit), limits) if limits is not None else (),
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
        "skipped": list(skipped.values()),
        "warnings": recordings.warnings,
        "provenance": provenance,
        "changes": recordings.manifest.changes,
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
    both: BothModels | None = None,
    limits: CalibrationLimits | None = None,
) -> Path:
    """Write the report as the file `out`, one self-contained page: completely, or not at all.

    `validation` and `diagnosis` may be None: the page says that they were not done. `provenance`: by default, what the
    recordings themselves tell. `both`: predictions by the baseline and the improved model, where both are known.
    `limits`: that the figures are judged by, where the laboratory states some. Raises InputError where the file can't
    be written."""
    file = Path(out)
    page = render_report(recordings, fit, validation, diagnosis, provenance or provenance_of(recordings), both, limits)
    return write_page(file, page)


def write_page(file: Path, page: str) -> Path:
    """Write a page completely, or not at all. Raises InputError where it can't be written."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file) as partial:
            partial.write_text(page, encoding="utf-8")
    except OSError as error:
        raise cannot_write(file, error, "name another place") from error
    return file
