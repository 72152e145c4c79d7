"""What discovered laws stand for: the mismatches that they describe, in place of smooth discrepancies; and what would
help where nothing predicts a mismatch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lab.diagnose.discovery.profile import PredictiveTable
from lab.diagnose.discovery.words import place_in_words
from lab.diagnose.inference.decide import Verdict
from lab.diagnose.inference.discrepancy import Discrepancy
from lab.diagnose.outcome.improved_model import Correction
from lab.diagnose.outcome.settling_capture import settling_sentence
from lab.diagnose.policy import DecisionPolicy
from lab.formats.camera_file import CameraFile
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Unexplained
from lab.measure.gaussian import Gaussian, chi2
from sim.camera import Side
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.library import list_changes
from sim.spectrum import FloatArray


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
        before, after = (_chi2(one, model.value, at) for one in (without, beside))
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


def _chi2(gaussian: Gaussian, value: FloatArray, at: slice) -> float:
    return chi2((value - gaussian.mean)[at], gaussian.covariance[at, at])


def left_to_smooth(verdict: Verdict, words: dict[int, str]) -> list[Discrepancy]:
    """Return the discrepancies as they enter the improved model: those that laws describe don't."""
    return [
        replace(one, log_odds=min(one.log_odds, 0.0)) if one.index in words else one for one in verdict.discrepancies
    ]


def with_laws(improved: CameraFile, laws: Sequence[EmpiricalLaw]) -> CameraFile:
    """Return the improved model with discovered laws; what they add to the dark noise, its read noise loses."""
    added_e2 = sum(float(np.mean(law.table)) for law in laws if law.stage == "signal" and law.of == "variance")
    read_e = float(np.sqrt(max(improved.camera.read_noise_e**2 - added_e2, 0.0)))
    camera = improved.camera.model_copy(update={"read_noise_e": read_e}) if added_e2 else improved.camera
    return replace(improved, camera=camera, effects=(*improved.effects, *laws))


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
