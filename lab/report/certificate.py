"""The certificate of a calibration: a page that is printed, and its content, with a hash that shows any change."""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2

from lab.calibration import life
from lab.calibration.life import CalibrationRecord
from lab.calibration.limits import Figure, Judgement
from lab.calibration.overview import verdict_of
from lab.capture.records import RunRecord
from lab.capture.store import Store
from lab.errors import InputError
from lab.formats.results.words import format_value
from lab.report import write_page
from lab.report.words import VERDICTS
from sim.parameters import Frozen

#: What a certificate states; revoking or superseding it changes none of these.
_STATED = {"id", "session_id", "created", "cameras", "certified", "certified_by", "expires", "limits", "judgements"}


class Certificate(Frozen):
    """What a certificate states. `sha256`: of `stated` and `fit_sha256`; `fit_sha256`: of the fit. Both are of JSON
    with sorted keys, without spaces, in UTF-8."""

    stated: dict[str, Any]
    fit_sha256: str
    sha256: str


def _sha256(document: Any) -> str:
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def certificate(store: Store, calibration: CalibrationRecord) -> Certificate:
    """Return the certificate of a calibration that was certified."""
    stated = calibration.model_dump(mode="json", include=_STATED)
    if calibration.limits is not None and not calibration.limits.drafted_from:  # as those of before there was this key
        del stated["limits"]["drafted_from"]
    fit = _sha256(store.result(calibration.id).document)
    return Certificate(stated=stated, fit_sha256=fit, sha256=_sha256({"stated": stated, "fit_sha256": fit}))


def rejections(store: Store, calibration: CalibrationRecord) -> tuple[str, ...]:
    """Return what speaks against a calibration, or its certificate: limits that were drafted from itself; its session's
    newest diagnosis where that rejects the model, or its lack."""
    dependence = None if calibration.limits is None else calibration.limits.dependence_on(calibration.id)
    first = () if dependence is None else (dependence,)
    newest = store.newest_results(calibration.session_id)
    if "diagnose" not in newest:
        return (*first, "The session isn't diagnosed: nobody looked whether the model leaves something out.")
    verdict = verdict_of(store, newest["diagnose"])
    if verdict in ("no_mismatch", "nothing_judged"):
        return first
    badge, _, words = VERDICTS[verdict]
    return (*first, f"The diagnosis rejects the model ({badge}): {words[0].lower()}{words[1:]}")


def certificate_page(store: Store, calibration: CalibrationRecord, runs: tuple[RunRecord, ...]) -> str:
    """Return the page of a calibration that was certified, which needs nothing else and prints on A4. `runs`: how its
    session was captured."""
    stated = certificate(store, calibration)
    judged = {(of.figure, of.side, of.place) for of in calibration.judgements}
    newest = store.newest_results(calibration.session_id)
    verdict = VERDICTS[verdict_of(store, newest["diagnose"])][2] if "diagnose" in newest else "not diagnosed"
    every = life.figures(store, calibration.id)
    return _template().render(
        version=metadata.version("calibench"),
        calibration=calibration,
        warnings=rejections(store, calibration),
        is_independent=calibration.limits is None or calibration.limits.dependence_on(calibration.id) is None,
        verdict=verdict,
        others=[figure for figure in every if (figure.name, figure.side, figure.place) not in judged],
        runs=runs,
        sha256=stated.sha256,
        fit_sha256=stated.fit_sha256,
    )


def _value(of: Judgement | Figure) -> str:
    return "missing" if of.value is None else format_value(of.value, of.std, of.unit)


def _band(band: tuple[float | None, float | None]) -> str:
    low, high = band
    return f"≤ {high:g}" if low is None else f"≥ {low:g}" if high is None else f"{low:g} … {high:g}"


@functools.cache
def _template() -> jinja2.Template:
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters |= {"value": _value, "band": _band}
    return environment.get_template("certificate.html")


def write_certificate(store: Store, calibration: CalibrationRecord, file: Path) -> Certificate:
    """Write the page of a calibration that was certified as `file` (HTML): completely, or not at all.

    Returns what the page states, with its hashes. Raises InputError where the calibration isn't certified or the file
    can't be written."""
    if calibration.certified is None:
        raise InputError(
            f"calibration {calibration.id}: is {calibration.state}, no certificate states it; certify it first"
        )
    try:
        runs = tuple(store.runs(calibration.session_id))
    except InputError:  # the session was deleted
        runs = ()
    write_page(file, certificate_page(store, calibration, runs))
    return certificate(store, calibration)
