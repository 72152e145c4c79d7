"""Routes that were removed: each says what took its place."""

from __future__ import annotations

from fastapi import APIRouter, HTTPException

from api.service import READ

router = APIRouter(include_in_schema=False)


@router.api_route("/challenges", methods=["GET", "POST"], dependencies=[READ])
@router.api_route("/challenges/{rest:path}", methods=["GET", "POST", "DELETE"], dependencies=[READ])
def removed_challenges() -> None:
    """Answer 410 in one line."""
    raise HTTPException(
        410, "challenges were removed from the service; in a checkout of the project, run `python -m evaluation`"
    )
