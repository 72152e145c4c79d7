"""What is left without a name: where measurements depart, the laws that describe it, and what is stated wrongly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special
from scipy.special import chdtri

from lab.diagnose.discovery.profile import PredictiveTable
from lab.diagnose.discovery.words import place_in_words
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.diagnose.inference.outlying import OutlyingLevel
from lab.diagnose.inference.places import Slice, describe
from lab.diagnose.inference.shown_in_means import is_judged_in_means, shown_in_means
from lab.diagnose.inference.weigh import UNKNOWN, Candidate
from lab.diagnose.outcome.corrections import Correction
from lab.diagnose.outcome.settling_capture import settling_sentence
from lab.diagnose.policy import DecisionPolicy
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    GeometryFit,
    Mismatch,
    Unexplained,
    VetoedName,
    ViewResiduals,
)
from lab.observables.boards.residuals import BOARDS
from lab.observables.boards.views import MIN_CORNERS
from lab.observables.gaussian import Gaussian, chi2
from lab.observables.observable import Observable
from sim.camera import Side
from sim.effects.base import Effect
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.library import list_changes
from sim.spectrum import FloatArray

#: Words for a mismatch that no slice shows.
WHOLE_AXIS = "along the whole axis"
#: Rivals that are listed beside a candidate.
LISTED_RIVALS = 3


def located(side: Side, verdict: Verdict) -> list[Mismatch]:
    """Return the most significant slice of every measurement. Where only an effect's score shows a mismatch, the
    measurement that it changes most, with the significance of its log odds: sqrt(2 log odds)."""
    model = verdict.model
    baseline = model.gaussian()
    found: dict[str, Mismatch] = {}
    for part in verdict.before:
        name = part.block.measurement.name
        if name not in found:
            where, captures = describe(model, baseline, part)
            sigma = round(part.significance_sigma, 2)
            found[name] = Mismatch(
                side=side, measurement=name, axis=part.axis, where=where, significance_sigma=sigma, captures=captures
            )
    for candidate in (*verdict.named, *verdict.abstained):
        changed = [b for b in model.blocks if b.touched_by(type(candidate.effect))]
        if changed and not any(b.measurement.name in found for b in changed):
            block = max(changed, key=lambda b: _change_chi2(verdict, candidate.effect, b))
            found[block.measurement.name] = Mismatch(
                side=side,
                measurement=block.measurement.name,
                axis=block.measurement.axis,
                where=f"{WHOLE_AXIS}, as {candidate.effect.name}",
                significance_sigma=round(float(np.sqrt(max(2.0 * candidate.log_odds, 0.0))), 2),
                captures=model.captures(False, model.mask(model.blocks.index(block))),
            )
    for part in verdict.held_out:
        name = part.block.measurement.name
        if name not in found:
            where, captures = describe(model, model.gaussian(verdict.effects), part)
            found[name] = Mismatch(
                side=side,
                measurement=name,
                axis=part.axis,
                where=f"{where}, in held-out captures",
                significance_sigma=_told_sigma(part),
                captures=captures,
            )
    return list(found.values())


def vetoed_names(side: Side, verdict: Verdict) -> list[VetoedName]:
    """Return the names that held-out captures contradict, in words."""
    return [
        VetoedName(
            side=side,
            name=one.candidate.told_name,
            probability=one.candidate.probability,
            captures=one.captures,
            chi2_before=one.chi2_without,
            chi2_after=one.chi2_with,
            n=one.n,
            statement=f"{one.candidate.told_name} is not named for the {side} camera: the captures that the choice "
            "used suggest it, but on "
            f"held-out captures chi2 rises by it from {one.chi2_without:.0f} to {one.chi2_with:.0f} for {one.n} "
            "numbers, more than chance allows"
            f"{', with a discrepancy beside its nearest law or in its place' if one.candidate.members else ''}.",
        )
        for one in verdict.vetoed
    ]


def held_by_families(verdict: Verdict, policy: DecisionPolicy) -> frozenset[str]:
    """Measurements whose remaining mismatch belongs to a named family: its nearest law shows there, and isn't exact."""
    return frozenset(m for c in verdict.named if c.holds_a_remainder for m in shown_in(verdict, c, policy))


def family_corrections(
    verdict: Verdict, candidate: Candidate, corrections: Sequence[Correction], policy: DecisionPolicy
) -> tuple[str, ...]:
    """Return what stands in the improved model beside a family's nearest law, in words."""
    if not candidate.holds_a_remainder:
        return ()
    shown = shown_in(verdict, candidate, policy)
    return tuple(one.said for one in corrections if one.measurement in shown)


def shown_in(verdict: Verdict, candidate: Candidate, policy: DecisionPolicy) -> tuple[str, ...]:
    """Measurements in which an effect's change stands out of the noise, the strongest change first; only that, where
    none does."""
    model = verdict.model
    changes = {
        b.measurement.name: _change_chi2(verdict, candidate.effect, b)
        for b in model.blocks
        if b.touched_by(type(candidate.effect))
    }
    least = max(policy.shown_chi2, policy.shown_share * max(changes.values(), default=0.0))
    strongest = sorted(changes, key=lambda m: -changes[m])
    return tuple(m for m in strongest if changes[m] > least) or (strongest[0],)


def _change_chi2(verdict: Verdict, effect: Effect, block: Observable) -> float:
    others = tuple(e for e in verdict.effects if e.name != effect.name)
    return verdict.model.change_chi2(effect, others, verdict.model.blocks.index(block))


def unexplained(
    recordings: RecordingSet,
    side: Side,
    verdict: Verdict,
    corrections: Sequence[Correction],
    policy: DecisionPolicy,
) -> list[Unexplained]:
    """Every mismatch that no name explains: where it is, the shape of its discrepancy, the nearest law, captures, and
    what to check.

    chi2 is of the seen numbers, without and with the discrepancy's covariance; of a mismatch that only held-out
    captures show, it is theirs. `corrections`: one for each discrepancy. What the nearest law of a named family leaves
    isn't listed."""
    model = verdict.model
    gaussian = model.gaussian(verdict.effects)
    held = held_by_families(verdict, policy)
    found = []
    for one, correction in zip(verdict.discrepancies, corrections, strict=True):
        if correction.measurement in held:
            continue
        block, at = model.blocks[one.index], model.slices[one.index]
        part = next((s for s in (*verdict.after, *verdict.held_out) if s.block is block), None)
        is_held_out = part is not None and part in verdict.held_out
        index = np.arange(at.start, at.stop)[model.seen[at]]
        before = _seen_chi2(model, gaussian, index)
        after = _seen_chi2(model, gaussian.with_discrepancy(one.index, one.kernel), index)
        if is_held_out and part is not None:
            before = after = part.chi2 * (1.0 + policy.covariance_slack) ** 2
        where, captures = (
            describe(model, gaussian, part)
            if part is not None
            else (WHOLE_AXIS, model.captures(False, model.mask(one.index)))
        )
        outlying = verdict.outlying.get(one.index, ())
        if outlying:
            captures = tuple(sorted({name for level in outlying for name in level.captures}))
        checks = [_level_check(recordings, level) for level in outlying]
        near = [] if is_held_out or outlying else [c for c in verdict.abstained if block.touched_by(type(c.effect))]
        remarked = max((c for c in near if c.remark), key=lambda c: c.log_odds, default=None)
        if remarked is not None:
            checks.append(f"The {side} camera looks {remarked.remark}: check what is stated of both.")
        found.append(
            Unexplained(
                side=side,
                measurement=block.measurement.name,
                axis=part.axis if part is not None else block.measurement.axis,
                where=where,
                shape=_shape(one, verdict, near, before, outlying, policy)
                if not is_held_out
                else _held_out_shape(outlying),
                significance_sigma=_told_sigma(part),
                chi2_before=before,
                chi2_after=after,
                n=part.n if is_held_out and part is not None else len(index),
                captures=captures,
                correction=correction.said,
                check=" ".join(checks),
            )
        )
    return found


def _told_sigma(part: Slice | None) -> float:
    return round(part.significance_sigma, 2) if part is not None else 0.0


def _seen_chi2(model: MeasurementModel, gaussian: Gaussian, index: np.ndarray) -> float:
    return chi2((model.value - gaussian.mean)[index], gaussian.covariance[np.ix_(index, index)])


def _level_check(recordings: RecordingSet, level: OutlyingLevel) -> str:
    """Return the exposure, or the light, that a level out of line with its statement would fit, as a sentence."""
    stated = {c.id: c.exposure_s for c in recordings.captures() if c.id in level.captures}
    exposure_s = float(np.mean(list(stated.values())))
    many = len(level.captures) > 1
    return (
        f"Capture{'s' if many else ''} {', '.join(level.captures)}: stated with {exposure_s:.6g} s, but "
        f"{'their' if many else 'its'} level is "
        f"that of {exposure_s * level.factor:.6g} ± {exposure_s * level.factor_std:.2g} s, or of {level.factor:.4f} ± "
        f"{level.factor_std:.1g} "
        "times the stated light: check both."
    )


def _held_out_shape(outlying: Sequence[OutlyingLevel]) -> str:
    """Return the shape of a mismatch that only held-out captures show, in words."""
    if outlying:
        return "single captures aren't in line with the others"
    return "held-out captures contradict the other captures"


def _shape(
    one: Discrepancy,
    verdict: Verdict,
    near: Sequence[Candidate],
    chi2_without: float,
    outlying: Sequence[OutlyingLevel],
    policy: DecisionPolicy,
) -> str:
    """Return the shape of a discrepancy, and the law nearest to it, in words."""
    if outlying:
        return _held_out_shape(outlying)
    block = verdict.model.blocks[one.index]
    nearest = _nearest(one, verdict, near, chi2_without, policy)
    law = f"; {nearest}" if nearest else ""
    if one.log_odds > 0:
        unit = block.measurement.unit
        kind = f"smooth over {one.length:.3g} {unit}, {one.grouping}" if one.length > 0 else one.grouping
        return f"a model discrepancy, {kind}, of relative size {one.amplitude:.2g}{law}"
    return f"irregular: no smooth discrepancy predicts captures that it hasn't seen{law}"


def _nearest(
    one: Discrepancy, verdict: Verdict, near: Sequence[Candidate], chi2_without: float, policy: DecisionPolicy
) -> str:
    """Return the nearest law of the library, and why it isn't named, in words: it leaves too much, or others fit as
    well. Empty where no law explains `near_share` of the excess of chi2 here."""
    model, at = verdict.model, verdict.model.slices[one.index]
    nearest = max(near, key=lambda c: c.log_odds, default=None)
    if nearest is None:
        return ""
    name = nearest.effect.name
    index = np.arange(at.start, at.stop)[model.seen[at]]
    others = tuple(e for e in verdict.effects if e.name != name)
    if not shown_in_means(model, nearest.effect, (*others, nearest.effect), others, policy):
        why = (
            "and these don't show it"
            if is_judged_in_means(model, type(nearest.effect))
            else "and no light of theirs is stated: state the flats' radiance or photons"
        )
        return f"the nearest law is {name}, which has to show in mean levels, {why}"
    left = _seen_chi2(model, model.gaussian((*others, nearest.effect)), index)
    if chi2_without - left < policy.near_share * (chi2_without - len(index)):
        return ""
    least = float(chdtri(len(index), policy.slice_false_alarm_rate)) * (1.0 + policy.covariance_slack) ** 2
    if left > least:
        told = f"chi2 is {left:.0f} with it, {chi2_without:.0f} without, {len(index)} are expected"
        return f"the nearest law is {name}, and it doesn't hold exactly: {told}"
    rivals = [
        f"{n} ({100 * p:.0f} %)"
        for n, p in nearest.rivals[:LISTED_RIVALS]
        if n != UNKNOWN and p >= policy.told_rival_probability
    ]
    if rivals:
        return (
            f"the nearest law is {name} ({100 * nearest.probability:.0f} %), which these recordings can't tell from "
            f"{', '.join(rivals)}"
        )
    return (
        f"the nearest law is {name}; what it leaves beside it in the same captures has no name, so that both may be "
        "one unknown cause"
    )


# ----------------------------------------------------------------------------------------------------------------------
# What discovered laws stand for: the mismatches that they describe, in place of smooth discrepancies; and what would
# help where nothing predicts a mismatch.


def described(
    verdict: Verdict, found: Sequence[PredictiveTable], laws: Sequence[EmpiricalLaw], policy: DecisionPolicy
) -> dict[int, str]:
    """Return the indices of the blocks that laws describe, and which do, in words.

    A law describes a mismatch where it takes `described_share` of the excess off its chi2, and where a smooth
    discrepancy doesn't predict the captures held out better. Steps between the lines of flats are predicted by no
    effect: there the index tells.
    """
    model, words = verdict.model, {}
    if not found:
        return {}
    without, beside = model.gaussian(verdict.effects), model.gaussian((*verdict.effects, *laws))
    for index in {d.index for d in verdict.discrepancies}:
        block, at = model.blocks[index], model.slices[index]
        mine = [one for one in found if block.measurement.name in one.look.shown_in]
        told = ", ".join(dict.fromkeys(f"the law of the {place_in_words(one.look)}" for one in mine))
        before, after = (_block_chi2(one, model.value, at) for one in (without, beside))
        is_felt = any(block.reads & list_changes(law) for law in laws)
        takes_off = before - after >= policy.described_share * (before - len(block.value))
        if mine and (not is_felt or (takes_off and not _is_smoother(verdict, laws, index))):
            words[index] = told
    return words


def _is_smoother(verdict: Verdict, laws: Sequence[EmpiricalLaw], index: int) -> bool:
    """Return whether a block's smooth discrepancy predicts its held-out numbers, beyond their noise, better than
    laws do."""
    if index not in verdict.kernels:
        return False
    model, where = verdict.model, verdict.model.mask(index)
    smooth, n = model.held_out(verdict.effects, where, verdict.kernels)
    others = {k: kernel for k, kernel in verdict.kernels.items() if k != index}
    return n > 0 and model.held_out((*verdict.effects, *laws), where, others)[0] > max(smooth, 2.0 * n)


def _block_chi2(gaussian: Gaussian, value: FloatArray, at: slice) -> float:
    return chi2((value - gaussian.mean)[at], gaussian.covariance[at, at])


def left_to_smooth(verdict: Verdict, words: dict[int, str]) -> list[Discrepancy]:
    """Return the discrepancies as they enter the improved model: those that laws describe don't."""
    return [
        replace(one, log_odds=min(one.log_odds, 0.0)) if one.index in words else one for one in verdict.discrepancies
    ]


def corrected_by_laws(
    verdict: Verdict, corrections: Sequence[Correction], words: dict[int, str]
) -> tuple[Correction, ...]:
    """Return the corrections of the improved model, discovered laws in the place of those that they describe."""
    titles = [verdict.model.blocks[one.index].measurement.title for one in verdict.discrepancies]
    return tuple(
        replace(one, said=f"{title}: {words[d.index]}, a discovered one") if d.index in words else one
        for one, title, d in zip(corrections, titles, verdict.discrepancies, strict=True)
    )


def in_light_of_laws(
    recordings: RecordingSet, side: Side, verdict: Verdict, left: Sequence[Unexplained], words: dict[int, str]
) -> list[Unexplained]:
    """Return mismatches without a name: with the law that describes each, or what would help where nothing does."""
    by_name = {verdict.model.blocks[index].measurement.name: told for index, told in words.items()}
    smooth = {verdict.model.blocks[index].measurement.name for index in verdict.kernels}
    found = []
    for one in left:
        told = by_name.get(one.measurement)
        if told is not None:
            found.append(one.model_copy(update={"shape": f"as {told}, which has no name"}))
        elif one.measurement in smooth or one.check:
            found.append(one)
        else:
            help_ = settling_sentence(recordings, side, [one]) or ""
            sentence = f"Nothing that was tried predicts it, neither a law along an index nor a smooth curve. {help_}"
            found.append(one.model_copy(update={"would_help": sentence.strip()}))
    return found


# ----------------------------------------------------------------------------------------------------------------------
# Corners of boards that depart from the fitted camera by more than their noise: the geometry fit's own error, as a
# finding.
#
# The fit frees the camera, Brown's distortion, the poses and each board's warp. What its residuals hold beyond noise is
# then the board's shape or print, motion, or a distortion that these terms don't follow. The noise of a corner doesn't
# come from the residuals' size, in which such an error would hide, but from the picture about the corner
# (`fit_corners`, `dot_centres`). Where that isn't known, it is the part of the residuals that neighbouring corners
# don't share (`fit_correlated_errors`).


ACROSS, DOWN = ("left", "middle", "right"), ("top", "middle", "bottom")
LISTED = 4  # captures, or parts of the frame, that are named
FLOOR_PX = 1e-3  # of a corner's noise: residuals below this are rounding
POSE_PARAMETERS = 6  # of a view: rotation and position


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
