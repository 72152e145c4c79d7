"""What a diagnosis found, in the words of the report's first screen, with what proves it: for pages that aren't the
report."""

from __future__ import annotations

import numpy as np

from lab.formats.results import DiagnosisResult, FitResult, ResidualCurve, ResidualPicture, ValidationResult
from lab.report import answers, words
from lab.report.answers import proof_curves, proof_words
from sim.parameters import Frozen


class ProofCurve(Frozen):
    """A measurement as recorded and as predicted, before and after the named effects, with its title and caption."""

    title: str
    caption: str
    curve: ResidualCurve


class DiagnosisFindings(Frozen):
    """`verdict` in two words, `headline` in a sentence, and the questions of the report's first screen with their
    `answers`. `proofs`: the two measurements that the baseline predicts worst. `pictures`: of each camera, the frame
    whose residuals the effects lessen most, where they do by a tenth at least."""

    verdict: str
    headline: str
    answers: dict[str, tuple[str, ...]]
    proofs: tuple[ProofCurve, ...]
    pictures: tuple[ResidualPicture, ...]


#: The share of a frame's rms residual that the effects take away where it is worth a picture.
WORTH_A_PICTURE = 0.1


def _explained_share(picture: ResidualPicture) -> float:
    """Return the share of the rms residual that the named effects take away."""
    before, after = (float(np.sqrt(np.nanmean(np.square(cells)))) for cells in (picture.before, picture.after))
    return 1.0 - after / max(before, 1e-12)


def _proof(curve: ResidualCurve) -> ProofCurve:
    title, caption = proof_words(curve)
    return ProofCurve(title=title, caption=caption, curve=curve)


def findings(fit: FitResult, validation: ValidationResult | None, diagnosis: DiagnosisResult) -> DiagnosisFindings:
    """Return what the page shows of a diagnosis, and of the fit and the validation that go with it."""
    verdict, _, headline = words.headline(diagnosis)
    shown = [picture for picture in diagnosis.pictures if _explained_share(picture) >= WORTH_A_PICTURE]
    best = {picture.side: picture for picture in sorted(shown, key=_explained_share)}
    return DiagnosisFindings(
        verdict=verdict,
        headline=headline,
        answers={question: tuple(lines) for question, lines in answers.answers(fit, validation, diagnosis) if lines},
        proofs=tuple(_proof(curve) for curve in proof_curves(diagnosis)),
        pictures=tuple(best[side] for side in sorted(best)),
    )
