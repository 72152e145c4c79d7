"""What the newest diagnosis of a session, or of recordings that were sent in, found: in words, with its proof."""

from __future__ import annotations

import functools

from fastapi import APIRouter

from api.errors import Conflict, answers
from api.service import READ, Here, HexId, Service, SessionId
from lab.capture.store import Store
from lab.formats.results import DiagnosisResult, FitResult, ValidationResult
from lab.report.findings import DiagnosisFindings, findings

router = APIRouter(tags=["jobs"])


@functools.lru_cache(maxsize=32)
def _make_findings(store: Store, diagnosis: str, fit: str | None, validation: str | None) -> DiagnosisFindings:
    """Of kept results, by their ids: they never change, and are long."""
    return findings(
        FitResult.model_validate(store.result(fit).document) if fit else FitResult(source="", cameras={}),
        ValidationResult.model_validate(store.result(validation).document) if validation else None,
        DiagnosisResult.model_validate(store.result(diagnosis).document),
    )


def _newest(service: Service, source: str, what: str) -> DiagnosisFindings:
    newest = service.store.newest_results(source)
    if "diagnose" not in newest:
        raise Conflict(f"{what}: isn't diagnosed yet; start a job of the kind diagnose")
    return _make_findings(service.store, newest["diagnose"], newest.get("fit"), newest.get("validate"))


@router.get("/sessions/{session_id}/findings", dependencies=[READ], responses=answers(401, 404, 409, 422))
def session_findings(service: Here, session_id: SessionId) -> DiagnosisFindings:
    """What the newest diagnosis of a session found, as the first screen of its report tells it: verdict, answers in
    sentences, the two measurements that prove it before and after, and where in a frame the baseline is wrong. 409
    before there is a diagnosis."""
    service.session(session_id)
    return _newest(service, session_id, f"session {session_id}")


@router.get("/recordings/{recordings_id}/findings", dependencies=[READ], responses=answers(401, 404, 409, 422))
def recordings_findings(service: Here, recordings_id: HexId) -> DiagnosisFindings:
    """What the newest diagnosis of recordings found."""
    folder = service.recordings(recordings_id)
    return _newest(service, str(folder), f"recordings {recordings_id}")
