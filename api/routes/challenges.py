"""Challenges: recording sets of cameras that conceal something, made and scored by jobs. Their truths are sealed until
they are scored."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter

from api.archives import ARCHIVE, Form, Packed
from api.errors import Conflict, answers, known
from api.kept_sets import challenge_folder
from api.pages_of_lists import HEADERS, PAGE, IdCursor, Limit, page_headers, page_of
from api.routes.jobs import accepted
from api.schemas import Challenge, ChallengeJobStart, ChallengeStart, Job
from api.service import CALIBRATE, READ, ROOM, Here, HexId, Service
from evaluation.kept import ChallengeWork, KeptChallenge
from evaluation.score import ChallengeScore
from evaluation.truth import Truths
from lab.errors import InputError

router = APIRouter(tags=["challenges"])
CaseName = Annotated[str, PathParameter(pattern=r"^case-[0-9]{4}$")]
WORK: dict[str, ChallengeWork] = {"make": "make-challenge", "score": "score-challenge"}


def _challenge(kept: KeptChallenge) -> Challenge:
    return Challenge(**kept.order.model_dump(), seals=kept.seals, scored=kept.scored)


def _known(service: Service, challenge_id: str) -> KeptChallenge:
    missing = f"no challenge {challenge_id!r}; GET /api/v1/challenges lists them"
    return known(missing, lambda: service.challenges.challenge(challenge_id))


@router.post("/challenges", status_code=202, dependencies=[CALIBRATE, ROOM], responses=answers(401, 403, 422))
def make_challenge(service: Here, start: ChallengeStart, response: Response) -> Job:
    """Make a challenge, as `calibench challenge make` does, in processes of their own; the job's `challenge_id` is the
    challenge. Its seed is drawn by the service, and sealed with the truths."""
    id = service.challenges.begin(start.cases, start.size, start.cfa, start.name)
    return accepted(service, service.jobs.submit("make-challenge", str(service.challenges.folder(id))), response)


@router.get("/challenges", dependencies=[READ], responses=answers(401, 422) | {200: {"headers": HEADERS}})
def list_challenges(
    service: Here, request: Request, response: Response, after: IdCursor = None, limit: Limit = PAGE
) -> list[Challenge]:
    """Challenges, the newest first, in pages."""
    every = service.challenges.all()
    page = page_of([one.order.id for one in every], after, limit, "challenge")
    page_headers(request, response, len(every), limit, page)
    return [_challenge(one) for one in every if one.order.id in page]


@router.get("/challenges/{challenge_id}", dependencies=[READ], responses=answers(401, 404, 422))
def get_challenge(service: Here, challenge_id: HexId) -> Challenge:
    """One challenge: what was asked for, and the seals of the cases that are made."""
    return _challenge(_known(service, challenge_id))


@router.delete(
    "/challenges/{challenge_id}", status_code=204, dependencies=[CALIBRATE], responses=answers(401, 403, 404, 409, 422)
)
def delete_challenge(service: Here, challenge_id: HexId) -> None:
    """Delete a challenge for ever: its recordings, its truths, its score. 409 while a job works on it."""
    challenge_folder(service, challenge_id).delete(service)


@router.post(
    "/challenges/{challenge_id}/jobs",
    status_code=202,
    dependencies=[CALIBRATE],
    responses=answers(401, 403, 404, 409, 422),
)
def start_challenge_job(service: Here, challenge_id: HexId, start: ChallengeJobStart, response: Response) -> Job:
    """`make` goes on where a job was stopped. `score` diagnoses every case that has no diagnosis yet, then opens the
    seals and scores; 409 until all cases are made, and while another job works on the challenge."""
    kept = _known(service, challenge_id)
    folder = str(service.challenges.folder(challenge_id))
    service.check_no_job(folder, f"challenge {challenge_id}")
    if start.kind == "score" and len(kept.seals) < kept.order.cases:
        raise Conflict(
            f"challenge {challenge_id}: {len(kept.seals)} of {kept.order.cases} cases are made; start a job of the "
            "kind make"
        )
    return accepted(service, service.jobs.submit(WORK[start.kind], folder), response)


@router.get(
    "/challenges/{challenge_id}/cases/{case}/archive.{form}",
    dependencies=[READ],
    response_class=Packed,
    responses=answers(401, 404, 409, 422) | ARCHIVE,
)
def challenge_case(service: Here, challenge_id: HexId, case: CaseName, form: Form) -> Response:
    """The recordings of a case, a recording set as a .zip or .tar: for other programs, or for a diagnosis of one's
    own."""
    return challenge_folder(service, challenge_id, case).archive(form)


def _opened(service: Service, challenge_id: str, what: Literal["score", "truths"]) -> Response:
    """As it was stored; 409 before the challenge is scored."""
    _known(service, challenge_id)
    try:
        return Response(service.challenges.opened(challenge_id, what), media_type="application/json")
    except InputError as error:
        raise Conflict(str(error)) from None


@router.get(
    "/challenges/{challenge_id}/score",
    dependencies=[READ],
    response_model=ChallengeScore,
    responses=answers(401, 404, 409, 422),
)
def challenge_score(service: Here, challenge_id: HexId) -> Response:
    """What `calibench challenge score --json` writes. 409 before it is scored."""
    return _opened(service, challenge_id, "score")


@router.get(
    "/challenges/{challenge_id}/truths",
    dependencies=[READ],
    response_model=Truths,
    responses=answers(401, 404, 409, 422),
)
def challenge_truths(service: Here, challenge_id: HexId) -> Response:
    """The truths with their salts and the seed, from which the seals follow. 409 before it is scored: they are sealed
    until then."""
    return _opened(service, challenge_id, "truths")
