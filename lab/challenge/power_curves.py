"""Power curves of the proof as a picture: share of right answers against separability, of the diagnosis and of the
oracle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lab.challenge.score import CaseScore, ChallengeScore, Rate

#: Borders of the classes of separability; values beyond them count in the first and the last class.
BORDERS = (1.0, 5.0, 10.0, 15.0, 25.0, 50.0, 100.0, 300.0, 2000.0)
WIDTH_PX, HEIGHT_PX, LEFT_PX, TOP_PX, GAP_PX = 330.0, 210.0, 62.0, 44.0, 66.0
MEASURED, ORACLE = "#1f5fa8", "#8a8f98"


def power_curves(found: ChallengeScore) -> str:
    """SVG with single effects at the left and compounds at the right. For each class of separability, at its geometric
    mean: the share of right diagnoses with its 95 % interval and the number of cases, and the mean share of the oracle
    on the same cases."""
    width, height = LEFT_PX + 2 * WIDTH_PX + GAP_PX + 24, TOP_PX + HEIGHT_PX + 92
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" font-family="sans-serif" '  # noqa: E501
            'font-size="12">'
        ),
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
    ]
    for column, (kind, title) in enumerate(
        (("single", "one effect: named first"), ("compound", "two effects: both named"))
    ):
        cases = [s for s in found.case_scores if s.kind == kind and s.separability is not None]
        parts += _panel(LEFT_PX + column * (WIDTH_PX + GAP_PX), title, cases)
    y = TOP_PX + HEIGHT_PX + 70
    for x, colour, words in (
        (LEFT_PX, MEASURED, "diagnosis"),
        (LEFT_PX + 120, ORACLE, "oracle: the best that could be"),
    ):
        parts.append(f'<rect x="{x}" y="{y - 9}" width="22" height="4" fill="{colour}"/>')
        parts.append(f'<text x="{x + 28}" y="{y - 2}" fill="#222">{words}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _panel(left: float, title: str, cases: Sequence[CaseScore]) -> list[str]:
    def across(strength: float) -> float:
        low, high = np.log(BORDERS[0]), np.log(BORDERS[-1])
        return left + WIDTH_PX * float((np.log(np.clip(strength, BORDERS[0], BORDERS[-1])) - low) / (high - low))

    def up(share: float) -> float:
        return TOP_PX + HEIGHT_PX * (1.0 - share)

    parts = [
        f'<text x="{left + WIDTH_PX / 2:.0f}" y="{TOP_PX - 18:.0f}" text-anchor="middle" fill="#222">{title}</text>'
    ]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        parts.append(
            f'<path d="M{left:.0f} {up(share):.1f}h{WIDTH_PX:.0f}" stroke="#d5d8dd"/><text x="{left - 8:.0f}" '
            f'y="{up(share) + 4:.1f}" '
            f'text-anchor="end" fill="#222">{100 * share:.0f} %</text>'
        )
    for strength in (1, 5, 10, 25, 50, 100, 300, 2000):
        x = across(strength)
        parts.append(
            f'<path d="M{x:.1f} {up(0):.1f}v5" stroke="#222"/><text x="{x:.1f}" y="{up(0) + 18:.1f}" '
            f'text-anchor="middle" fill="#222">{strength}</text>'
        )
    parts.append(
        f'<text x="{left + WIDTH_PX / 2:.0f}" y="{up(0) + 38:.1f}" text-anchor="middle" fill="#222">separability</text>'
    )
    if not cases:
        parts.append(
            f'<text x="{left + WIDTH_PX / 2:.0f}" y="{up(0.5):.1f}" text-anchor="middle" fill="#222">no case</text>'
        )
        return parts
    classes = _by_class(cases)
    places = [
        across(float(np.exp(np.mean([np.log(max(s.separability or 0.0, BORDERS[0])) for s in held]))))
        for held in classes
    ]
    known = [
        (x, up(float(np.mean([s.oracle_share for s in held if s.oracle_share is not None]))))
        for x, held in zip(places, classes, strict=True)
        if any(s.oracle_share is not None for s in held)
    ]
    parts.append(_line(known, ORACLE))
    rates = [Rate.over(s.right for s in held) for held in classes]
    parts.append(_line([(x, up(rate.share or 0.0)) for x, rate in zip(places, rates, strict=True)], MEASURED))
    for x, rate in zip(places, rates, strict=True):
        y, low, high = (up(share or 0.0) for share in (rate.share, rate.low, rate.high))
        parts.append(
            f'<path d="M{x:.1f} {low:.1f}V{high:.1f}" stroke="{MEASURED}" stroke-opacity="0.5"/><circle cx="{x:.1f}" '
            f'cy="{y:.1f}" r="3.5" '
            f'fill="{MEASURED}"/><text x="{x + 5:.1f}" y="{y - 6:.1f}" fill="{MEASURED}" '
            f'font-size="10">{rate.of}</text>'
        )
    return parts


def _by_class(cases: Sequence[CaseScore]) -> list[list[CaseScore]]:
    """Cases by classes of separability, without empty ones."""
    at = np.clip(np.searchsorted(BORDERS, [s.separability or 0.0 for s in cases], side="right"), 1, len(BORDERS) - 1)
    held = [[s for s, k in zip(cases, at, strict=True) if k == wanted] for wanted in range(1, len(BORDERS))]
    return [group for group in held if group]


def _line(points: Sequence[tuple[float, float]], colour: str) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>'
