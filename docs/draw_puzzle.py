"""Draw docs/puzzle.svg: MTF and spectral responsivity, measured, before and after the diagnosis named what the model
left out.

    .venv/bin/python docs/draw_puzzle.py        (a minute)

A camera of the independent simulator (`evaluation.independent_simulator`, which shares no code with the models that the
diagnosis fits) conceals an optical low-pass filter of 1.6 um and an infrared-cut filter at 645 nm. Its recordings are
diagnosed, and the curves of the result are drawn: the measured ones with bars of two standard deviations, the
baseline's prediction dashed, the improved model's solid. Open points are captures that the diagnosis held out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from evaluation.draw import recordings_of
from evaluation.independent_simulator import ConcealedCamera, Plan
from evaluation.independent_simulator.laws import InfraredCutFilterLaw, OpticalLowPassFilterLaw
from lab.diagnose import diagnose
from lab.effect_titles import effect_title
from lab.formats.recording_set import RecordingSet
from lab.formats.results import DiagnosisResult, ResidualCurve

SEED, LOW_PASS_UM, BELOW_720_NM = 20751, 1.6, 75.0  # the filter's edge lies that far below 720 nm
EDGE = "5 deg"
COLOUR = {"R": "#c43b4e", "G": "#23874a", "B": "#2f66c4"}
INK, MUTED, GRID = "#1b1f24", "#57606a", "#e2e5e9"
WIDTH, HEIGHT = 1000, 430
TOP, BOTTOM = 62, 372  # of the panels
FIELDS = ("measured", "measured_std", "before", "after")

#: A curve's field in the units of its panel.
Scale = Callable[[ResidualCurve, str], np.ndarray]


@dataclass(frozen=True)
class Points:
    """One channel's curve in the units of its panel."""

    channel: str
    x: np.ndarray
    measured: np.ndarray
    std: np.ndarray
    before: np.ndarray
    after: np.ndarray
    held_out: np.ndarray


@dataclass(frozen=True)
class Panel:
    """Axes of a panel: its place (px), its ranges, ticks and titles."""

    left: float
    right: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    x_ticks: Sequence[float]
    y_ticks: Sequence[float]
    title: str
    x_title: str
    y_title: str

    def x(self, value: float) -> float:
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.right - self.left)

    def y(self, value: float) -> float:
        low, high = self.y_range
        return BOTTOM - (value - low) / (high - low) * (BOTTOM - TOP)


def main() -> None:
    recordings = record()
    result = diagnose(recordings)
    edges = points_of(result, "slanted_edge", EDGE, ("G",), unscaled)
    sweep = points_of(result, "narrowband", "narrowband", ("R", "G", "B"), responsivity(recordings))
    file = Path(__file__).with_name("puzzle.svg")
    file.write_text(drawing(result, edges, sweep), encoding="utf-8")
    print(f"{file}: {', '.join(effect.name for effect in result.effects)}")


def record() -> RecordingSet:
    """The concealed camera's session."""
    laws = [OpticalLowPassFilterLaw(LOW_PASS_UM), InfraredCutFilterLaw(BELOW_720_NM)]
    camera = ConcealedCamera(SEED, laws, cfa="RGGB", f_number=4.0, rows=288, cols=384)
    return recordings_of(camera, Plan(("dark", "flat", "narrowband", "slanted_edge")))


def responsivity(recordings: RecordingSet) -> Scale:
    """Raw DN of narrowband captures as DN above black per radiant exposure, DN / (mJ sr^-1 m^-2)."""
    black_dn = recordings.camera("left").black_level_dn
    assert black_dn is not None
    exposure_mj: dict[float, float] = {}
    for capture in recordings.captures("narrowband", "left"):
        wavelength_nm, radiance = recordings.spectrum(capture.radiance).arrays
        exposure_mj[capture.wavelength_nm] = 1e3 * float(np.trapezoid(radiance, wavelength_nm)) * capture.exposure_s

    def scaled(curve: ResidualCurve, field: str) -> np.ndarray:
        values = np.array(getattr(curve, field)) - (0.0 if field == "measured_std" else black_dn)
        return values / [exposure_mj[x] for x in curve.x]

    return scaled


def unscaled(curve: ResidualCurve, field: str) -> np.ndarray:
    """A curve's values as they are."""
    return np.array(getattr(curve, field))


def points_of(
    result: DiagnosisResult, measurement: str, label: str, channels: Sequence[str], scaled: Scale
) -> list[Points]:
    """Curves of one measurement by channel in the order of x, those of held-out captures among them."""
    found = []
    for channel in channels:
        mine = [c for c in result.curves if (c.measurement, c.label, c.channel) == (measurement, label, channel)]
        x = np.concatenate([curve.x for curve in mine])
        held_out = np.concatenate([np.full(len(curve.x), curve.held_out) for curve in mine])
        order = np.lexsort([held_out, x])
        values = (np.concatenate([scaled(curve, field) for curve in mine])[order] for field in FIELDS)
        found.append(Points(channel, x[order], *values, held_out[order]))
    return found


# --- the picture ------------------------------------------------------------------------------------------------------


def drawing(result: DiagnosisResult, edges: Sequence[Points], sweep: Sequence[Points]) -> str:
    """The picture as SVG."""
    top = 1.08 * max(float(np.max(points.measured)) for points in sweep)
    step = 10.0 ** np.floor(np.log10(top)) * (1.0 if top / 10.0 ** np.floor(np.log10(top)) > 4 else 0.5)
    mtf = Panel(
        70, 470, (0.0, 1.2), (-0.05, 1.05), (0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2), (0, 0.2, 0.4, 0.6, 0.8, 1.0),
        "MTF of a slanted edge at 5°, green", "spatial frequency, cycles / pixel", "MTF",
    )  # fmt: skip
    sensitivity = Panel(
        570, 975, (395.0, 725.0), (-0.05 * top, top), tuple(range(400, 721, 40)), tuple(np.arange(0.0, top, step)),
        "Spectral responsivity, red, green and blue", "wavelength, nm", "DN / (mJ sr⁻¹ m⁻²)",
    )  # fmt: skip
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
            "font-family=\"system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', sans-serif\" font-size=\"13\" "
            f'fill="{INK}">'
        ),
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
    ]
    for panel, curves in ((mtf, edges), (sensitivity, sweep)):
        parts += axes(panel)
        for points in curves:
            parts += curve(panel, points)
    parts += key(mtf)
    parts += named(result, mtf, "optical_low_pass_filter", ("displacement_x_um", "displacement_y_um"))
    parts += named(result, sensitivity, "infrared_cut_filter", ("cut_wavelength_nm",))
    return "\n".join([*parts, "</svg>\n"])


def axes(panel: Panel) -> list[str]:
    """Grid, ticks and titles of a panel."""
    parts = [f'<text x="{panel.left}" y="{TOP - 38}" font-size="15" font-weight="600">{escape(panel.title)}</text>']
    for tick in panel.y_ticks:
        y = panel.y(tick)
        parts.append(f'<line x1="{panel.left}" x2="{panel.right}" y1="{y:.1f}" y2="{y:.1f}" stroke="{GRID}"/>')
        parts.append(text(panel.left - 8, y + 4, f"{tick:g}", anchor="end", fill=MUTED))
    for tick in panel.x_ticks:
        x = panel.x(tick)
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{BOTTOM}" y2="{BOTTOM + 5}" stroke="{MUTED}"/>')
        parts.append(text(x, BOTTOM + 20, f"{tick:g}", anchor="middle", fill=MUTED))
    parts.append(f'<line x1="{panel.left}" x2="{panel.right}" y1="{BOTTOM}" y2="{BOTTOM}" stroke="{MUTED}"/>')
    parts.append(text(0.5 * (panel.left + panel.right), BOTTOM + 42, panel.x_title, anchor="middle"))
    x, y = panel.left - 46, 0.5 * (TOP + BOTTOM)
    turned = f' transform="rotate(-90 {x} {y})"'
    parts.append(text(x, y, panel.y_title, anchor="middle", more=turned))
    return parts


def curve(panel: Panel, points: Points) -> list[str]:
    """Baseline dashed, improved model solid, measured points with bars of two standard deviations."""
    colour = COLOUR[points.channel]
    x = np.array([panel.x(value) for value in points.x])
    # held-out and other captures at the same x have the same prediction
    first = np.concatenate([[True], np.diff(points.x) > 0])
    parts = []
    for values, look in (
        (points.before, 'stroke-width="1.8" stroke-dasharray="6 4" stroke-opacity="0.75"'),
        (points.after, 'stroke-width="2"'),
    ):
        line = " ".join(f"{a:.1f},{panel.y(b):.1f}" for a, b in zip(x[first], values[first], strict=True))
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" {look}/>')
    for at, value, std, open_ in zip(x, points.measured, points.std, points.held_out, strict=True):
        low, high = panel.y(value - 2 * std), panel.y(value + 2 * std)
        parts.append(f'<line x1="{at:.1f}" x2="{at:.1f}" y1="{low:.1f}" y2="{high:.1f}" stroke="{colour}"/>')
        parts.append(
            f'<circle cx="{at:.1f}" cy="{panel.y(value):.1f}" r="2.6" fill="{"#ffffff" if open_ else colour}" '
            f'stroke="{colour}" stroke-width="1.3"/>'
        )
    return parts


def key(panel: Panel) -> list[str]:
    """What dots and lines mean, in the upper right corner of a panel."""
    x, y = panel.right - 172, TOP + 6
    colour = COLOUR["G"]
    entries = (
        (f'<circle cx="{x}" cy="0" r="3.4" fill="{colour}"/>', "measured, bars ± 2 σ"),
        (f'<circle cx="{x}" cy="0" r="3.4" fill="#fff" stroke="{colour}" stroke-width="1.4"/>', "measured, held out"),
        (
            (
                f'<line x1="{x - 14}" x2="{x + 14}" y1="0" y2="0" stroke="{colour}" stroke-width="1.8" '
                'stroke-dasharray="6 4"/>'
            ),
            "baseline model",
        ),
        (f'<line x1="{x - 14}" x2="{x + 14}" y1="0" y2="0" stroke="{colour}" stroke-width="2"/>', "improved model"),
    )
    return [
        f'<g transform="translate(0 {y + 20 * k})">{mark}{text(x + 22, 4, words)}</g>'
        for k, (mark, words) in enumerate(entries)
    ]


def named(result: DiagnosisResult, panel: Panel, effect: str, parameters: Sequence[str]) -> list[str]:
    """The effect that the diagnosis named for a panel's mismatch, its parameters with their standard deviations."""
    found = next(item for item in result.effects if item.name == effect)
    values = [found.parameters[name] for name in parameters]
    sizes = ", ".join(f"{value.value:.{digits(value.std)}f} ± {value.std:.{digits(value.std)}f}" for value in values)
    unit = values[0].unit.replace("um", "µm")
    words = f"named: {effect_title(effect)}, {sizes} {unit}"
    return [text(panel.left, TOP - 18, words, fill=MUTED)]


def digits(std: float | None) -> int:
    """Decimal places that show two digits of a standard deviation."""
    return max(0, 1 - int(np.floor(np.log10(std)))) if std else 3


def text(x: float, y: float, words: str, *, anchor: str = "start", fill: str = INK, more: str = "") -> str:
    """A line of text."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{fill}"{more}>{escape(words)}</text>'


if __name__ == "__main__":
    main()
