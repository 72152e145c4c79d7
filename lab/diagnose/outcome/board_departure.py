"""Corners of boards that depart from the fitted camera by more than their noise: the geometry fit's own error, as a
finding.

The fit frees the camera, Brown's distortion, the poses and each board's warp. What its residuals hold beyond noise is
then the board's shape or print, motion, or a distortion that these terms don't follow. The noise of a corner doesn't
come from the residuals' size, in which such an error would hide, but from the picture about the corner (`fit_corners`,
`dot_centres`). Where that isn't known, it is the part of the residuals that neighbouring corners don't share
(`fit_correlated_errors`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from lab.diagnose.measurements.boards import BOARDS
from lab.diagnose.policy import DecisionPolicy
from lab.formats.results import GeometryFit, Unexplained, ViewResiduals
from lab.measure.board_detection import MIN_CORNERS
from sim.camera import Side
from sim.spectrum import FloatArray

ACROSS, DOWN = ("left", "middle", "right"), ("top", "middle", "bottom")
LISTED = 4  # captures, or parts of the frame, that are named
FLOOR_PX = 1e-3  # of a corner's noise: residuals below this are rounding
POSE_PARAMETERS = 6


@dataclass(frozen=True)
class _Departure:
    """The corners of a part: standard deviation of a coordinate as found and as noise explains it, px; chi2 of n
    numbers."""

    found_px: float
    noise_px: float
    chi2: float
    n: float

    @property
    def departure_px(self) -> float:
        """Standard deviation of a coordinate beyond noise, px."""
        return float(np.sqrt(max(self.found_px**2 - self.noise_px**2, 0.0)))

    def sigma(self, slack: float) -> float:
        """chi2 as a quantile of the normal distribution (Wilson and Hilferty 1931), with standard deviations `slack`
        too small."""
        spread = 2.0 / (9.0 * self.n)
        return float((np.cbrt(self.chi2 / (1.0 + slack) ** 2 / self.n) - 1.0 + spread) / np.sqrt(spread))


def board_departure(
    side: Side, geometry: GeometryFit | None, shape: tuple[int, int], policy: DecisionPolicy
) -> Unexplained | None:
    """Return where and by how much the corners of a fit depart from its camera; None where noise and
    `corner_tolerance_px` explain them.

    All corners, those of each view, and those of each ninth of a frame of `shape` (rows, cols) are tested. A part
    departs where its chi2 against noise is beyond `slice_false_alarm_rate`, corrected for the number of parts, and its
    departure beyond noise is larger than both `corner_tolerance_px` and the noise.
    """
    if geometry is None or not geometry.residuals:
        return None
    views = geometry.residuals
    place = np.array([at for view in views for at in zip(view.x_px, view.y_px, strict=True)])
    rest = np.array([at for view in views for at in zip(view.dx_px, view.dy_px, strict=True)])
    of_view = np.concatenate([np.full(len(view.corner), k) for k, view in enumerate(views)])
    noise_px = np.array([_noise_px(geometry, view) for view in views])[of_view]
    share = 1.0 - (len(geometry.parameters) + POSE_PARAMETERS * len(views)) / rest.size
    if not share > 0.0 or np.isnan(noise_px).any():
        return None
    col, row = np.clip((place + 0.5) / shape[::-1] * 3, 0, 2).astype(int).T
    cells = {
        " ".join(dict.fromkeys((down, across))): (col == k) & (row == i)
        for i, down in enumerate(DOWN)
        for k, across in enumerate(ACROSS)
    }
    whole = _part(rest, noise_px, share)
    by_view = {view.capture: _part(rest[of_view == k], noise_px[of_view == k], share) for k, view in enumerate(views)}
    by_cell = {name: _part(rest[at], noise_px[at], share) for name, at in cells.items() if at.sum() >= MIN_CORNERS}
    least_sigma = -float(special.ndtri(policy.slice_false_alarm_rate / (1 + len(by_view) + len(by_cell))))

    def departs(part: _Departure) -> bool:
        is_large = part.departure_px > max(policy.corner_tolerance_px, part.noise_px)
        return is_large and part.sigma(policy.covariance_slack) > least_sigma

    bad_views, bad_cells = (
        {name: part for name, part in parts.items() if departs(part)} for parts in (by_view, by_cell)
    )
    departing = [whole] if departs(whole) else [*bad_views.values(), *bad_cells.values()]
    if not departing:
        return None
    worst = max(departing, key=lambda part: part.departure_px)
    return Unexplained(
        side=side, measurement=BOARDS.name, axis=BOARDS.axis, where=_where(bad_views, bad_cells, len(views)),
        shape=f"the corners of boards depart from the camera's geometry by {worst.found_px:.2f} px (standard "
            "deviation of a "
        f"coordinate), noise explains {worst.noise_px:.2f} px; a bent board, an unflat print or a distortion beyond "
        "the "
        "fitted terms does that",
        significance_sigma=round(worst.sigma(policy.covariance_slack), 2),
        chi2_before=worst.chi2, chi2_after=worst.n, n=round(worst.n), captures=tuple(sorted(bad_views or by_view)),
        correction="none: the geometry's standard deviations hold what neighbouring corners share",
    )  # fmt: skip


def _noise_px(geometry: GeometryFit, view: ViewResiduals) -> float:
    """Standard deviation of a coordinate by noise, px: of the view's picture, else of what neighbouring corners don't
    share; NaN where neither is known."""
    known = view.noise_px
    if known is None:
        known = geometry.corner_errors.noise_px if geometry.corner_errors is not None else np.nan
    return float(np.maximum(known, FLOOR_PX))


def _part(rest: FloatArray, noise_px: FloatArray, share: float) -> _Departure:
    n = share * rest.size
    chi2 = float(np.sum(np.square(rest / noise_px[:, None])))
    return _Departure(float(np.sqrt(np.sum(rest**2) / n)), float(np.sqrt(np.mean(noise_px**2))), chi2, n)


def _where(views: dict[str, _Departure], cells: dict[str, _Departure], count: int) -> str:
    """Captures and parts of the frame that depart, in words, the worst first."""
    words = []
    if views:
        more = f" and {len(views) - LISTED} more" if len(views) > LISTED else ""
        words.append(f"{len(views)} of {count} captures: {_listed(views)}{more}")
    if cells:
        words.append(f"in the frame at the {_listed(cells)}")
    return "; ".join(words) or f"all {count} captures alike"


def _listed(parts: dict[str, _Departure]) -> str:
    worst = sorted(parts.items(), key=lambda item: -item[1].found_px)[:LISTED]
    return ", ".join(f"{name} ({part.found_px:.2f} px)" for name, part in worst)
