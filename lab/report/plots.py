"""Charts of results, one at a time: the report's figures as objects that show themselves in a notebook."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial, singledispatch
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.calibration.life import History
from lab.errors import InputError
from lab.formats.raw_file import replacing
from lab.formats.results import (
    DiagnosisResult,
    Emva1288Points,
    FitResult,
    MtfCurve,
    PhotonTransfer,
    SpectralFit,
    ValidationResult,
)
from lab.pipeline import PipelineResult
from lab.report import charts
from lab.report.answers import proof_curves, proof_words
from lab.report.charts import Figure, Trace
from lab.report.diagnosis import worst_of_each
from lab.report.stills import still

if TYPE_CHECKING:
    import plotly.graph_objects

#: The named colours of a figure, on white.
ON_WHITE = {"@fg": "#1b1b1b", "@muted": "#777777", "@grid": "#dddddd"}
#: Curves of a diagnosis that are offered, the worst of each measurement first.
CURVES = 12
_numbers = itertools.count(1)


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart of a result: a Plotly figure with a title.

    A notebook shows it by itself: as an interactive chart where the front end draws Plotly's figures (VS Code,
    JupyterLab with Plotly's extension), as a picture (SVG) elsewhere.

    what : which chart of the result it is, as `plot` takes it
    title : what it shows
    figure : the Plotly figure, with the page's named colours
    """

    what: str
    title: str
    figure: Figure

    def to_dict(self) -> dict[str, Any]:
        """Return the Plotly figure as a dictionary, for `plotly.io.show` and for other programs."""
        figure: dict[str, Any] = _on_white({"data": self.figure["data"], "layout": self.figure["layout"]})
        figure["layout"] |= {"title": {"text": self.title, "font": {"size": 14}}, "paper_bgcolor": "#ffffff"}
        figure["layout"]["margin"] = figure["layout"]["margin"] | {"t": 76}
        return figure

    def to_plotly(self) -> plotly.graph_objects.Figure:
        """Return the chart as `plotly.graph_objects.Figure`. Needs plotly (calibench's extra `notebook`).

        Raises InputError where plotly isn't installed."""
        try:
            from plotly.graph_objects import Figure as PlotlyFigure
        except ImportError as error:
            raise InputError("plotly isn't installed; pip install 'calibench[notebook]'") from error
        return PlotlyFigure(self.to_dict())

    def to_svg(self) -> str:
        """Return the chart as a picture, SVG."""
        drawn = str(still(self.figure, next(_numbers)))
        colours = ";".join(f"--{name[1:]}:{colour}" for name, colour in ON_WHITE.items())
        opening = '<svg xmlns="http://www.w3.org/2000/svg" font-family="system-ui, sans-serif" width="620" '
        return drawn.replace("<svg ", opening, 1).replace('style="', f'style="{colours};background:#fff;', 1)

    def write(self, file: str | Path) -> Path:
        """Write the chart to `file`: `.svg`, or `.json` (the Plotly figure). Returns the path. Raises InputError for
        another ending."""
        path = Path(file)
        if path.suffix not in (".svg", ".json"):
            raise InputError(f"{path}: no format of a chart; end the name in .svg or .json, or use to_plotly()")
        with replacing(path) as partial:
            partial.write_text(
                self.to_svg() if path.suffix == ".svg" else charts.figure_json(self.to_dict()), encoding="utf-8"
            )
        return path

    def _repr_html_(self) -> str:
        return picture(self)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        return {
            "application/vnd.plotly.v1+json": self.to_dict(),
            "text/html": self._repr_html_(),
            "text/plain": f"Chart: {self.title}",
        }


def picture(chart: Chart) -> str:
    """Return a chart as HTML: title and picture."""
    import base64

    data = base64.b64encode(chart.to_svg().encode()).decode("ascii")
    return (
        f'<figure style="margin:0.6em 0"><figcaption>{escape(chart.title)}</figcaption>'
        f'<img alt="{escape(chart.title, quote=True)}" src="data:image/svg+xml;base64,{data}"></figure>'
    )


def _on_white(value: Any) -> Any:
    """Return a part of a figure with its named colours replaced, and its arrays as lists."""
    if isinstance(value, dict):
        return {key: _on_white(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_on_white(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return ON_WHITE.get(value, value) if isinstance(value, str) else value


@singledispatch
def charts_of(result: object) -> Iterator[Chart]:
    """Yield the charts of a result, the one that tells most first; none of what has no chart.

    result : of `calibench.fit`, `validate`, `diagnose`, `compare`, `predict`, `score` or `certify`

    >>> import calibench
    >>> list(calibench.charts_of(calibench.FitResult(source="my-camera", cameras={})))
    []
    """
    yield from ()


@charts_of.register
def _(result: FitResult) -> Iterator[Chart]:
    for side, camera in result.cameras.items():
        makers: list[tuple[str, str, Callable[[], Figure | None]]] = []
        if (noise := camera.noise) is not None:
            makers += [
                ("photon_transfer", "photon transfer", partial(charts.photon_transfer, noise)),
                ("linearity", "deviation from a linear response", partial(charts.linearity, noise)),
            ]
        if (spectral := camera.spectral) is not None and spectral.quantum_efficiency:
            makers.append(("quantum_efficiency", "quantum efficiency", partial(charts.quantum_efficiency, spectral)))
        if camera.mtf:
            makers.append(("mtf", "MTF of the slanted edges", partial(charts.mtf_curves, camera.mtf)))
        for drift in camera.repeat_drifts:
            makers.append(("repeat_drift", f"drift of repeats, {drift.kind}", partial(charts.repeat_drift, drift)))
        for what, title, make in makers:
            if (figure := make()) is not None:
                yield Chart(f"{side} {what}", f"{side}: {title}", figure)


@charts_of.register
def _(result: ValidationResult) -> Iterator[Chart]:
    for check in sorted(result.checks, key=lambda check: -check.chi2 / max(check.n, 1)):
        name = f"{check.side} {check.name} {check.capture}"
        title = f"{check.side}: {check.name} of {check.capture}, measured and predicted"
        if check.curves:
            yield Chart(name, title, charts.draw_predicted_curves(check.curves))
        elif check.patches:
            yield Chart(name, title, charts.draw_predicted_patches(check.patches))


@charts_of.register
def _(result: DiagnosisResult) -> Iterator[Chart]:
    proofs = proof_curves(result)
    others = [
        curve for curve in worst_of_each([c for c in result.curves if len(c.x) > 3], CURVES) if curve not in proofs
    ]
    for curve in (*proofs, *others):
        title, caption = proof_words(curve)
        yield Chart(f"{curve.side} {curve.measurement}", f"{title}. {caption}", charts.residual_curve(curve))


@charts_of.register
def _(result: PipelineResult) -> Iterator[Chart]:
    for part in (result.diagnosis, result.validation, result.fit):
        yield from charts_of(part)


@charts_of.register
def _(result: MtfCurve) -> Iterator[Chart]:
    yield Chart("mtf", f"MTF of {result.capture}, {result.channel}", charts.mtf_curves([result]))


@charts_of.register
def _(result: SpectralFit) -> Iterator[Chart]:
    if result.quantum_efficiency:
        yield Chart("quantum_efficiency", "quantum efficiency", charts.quantum_efficiency(result))


@charts_of.register
def _(result: PhotonTransfer) -> Iterator[Chart]:
    yield Chart("photon_transfer", "photon transfer", charts.photon_transfer_points(result))


@charts_of.register
def _(result: Emva1288Points) -> Iterator[Chart]:
    signal = np.asarray(result.mean_dn) - np.asarray(result.dark_mean_dn)
    excess = np.asarray(result.variance_dn2) - np.asarray(result.dark_variance_dn2)
    points: Trace = {"type": "scatter", "mode": "markers", "name": "levels", "x": signal.tolist(), "y": excess.tolist()}
    points |= {"marker": {"color": charts.AFTER, "size": 6}}
    axes = {
        "xaxis": charts.axis("mean less dark, DN", rangemode="tozero"),
        "yaxis": charts.axis("temporal variance less dark, DN²", rangemode="tozero"),
    }
    figure = {"data": [points], "layout": charts.layout(300, **axes)}
    yield Chart("photon_transfer", "photon transfer (EMVA 1288)", figure)


@charts_of.register
def _(result: History) -> Iterator[Chart]:
    points: Trace = {"type": "scatter", "mode": "lines+markers", "name": result.camera}
    points |= {"x": [float(k + 1) for k in range(len(result.points))], "y": [point.value for point in result.points]}
    points |= {"error_y": charts.error_bars([point.std for point in result.points], charts.AFTER)}
    points |= {"marker": {"color": charts.AFTER, "size": 6}, "line": {"color": charts.AFTER, "width": 1}}
    title = result.title or result.figure
    axes = {
        "xaxis": charts.axis("calibration, oldest first"),
        "yaxis": charts.axis(title if result.unit == "1" else f"{title}, {result.unit}"),
    }
    yield Chart("history", f"{title} of {result.camera}", {"data": [points], "layout": charts.layout(280, **axes)})


def plot(result: object, what: str = "") -> Chart:
    """Draw one chart of a result.

    result : a fit, a validation, a diagnosis, what `evaluate` found, one MTF or sensitivity, or a history
    what : which chart, or the beginning or the end of its name: `mtf`, `left photon_transfer`; empty: the first.
        `charts_of(result)` yields them all

    Returns a Plotly figure that shows itself. Raises InputError where the result has no such chart; the line names
    those that it has.

    >>> import calibench
    >>> curve = calibench.MtfCurve(capture="edge", channel="G", angle_deg=5.0,
    ...     frequency_cy_per_px=(0.0, 0.25, 0.5), mtf=(1.0, 0.5, 0.1), mtf_std=(0.0, 0.01, 0.01))
    >>> chart = calibench.plot(curve)
    >>> chart.title
    'MTF of edge, G'
    >>> chart.to_dict()["layout"]["xaxis"]["title"]["text"]
    'spatial frequency, cy/px'
    """
    known: list[str] = []
    for chart in charts_of(result):
        if not what or chart.what.startswith(what) or chart.what.endswith(f" {what}") or f" {what} " in chart.what:
            return chart
        known.append(chart.what)
    there = f"take one of {', '.join(dict.fromkeys(known))}" if known else "it has none"
    raise InputError(f"{type(result).__name__}: no chart {what or 'at all'}; {there}")
