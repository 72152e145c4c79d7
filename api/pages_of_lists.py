"""Long lists in pages: `limit` items, those after a cursor; the number of all items and the next page stand in
headers."""

from __future__ import annotations

from typing import Annotated

from fastapi import HTTPException, Query, Request, Response

#: Items of a page where the request doesn't say how many.
PAGE = 100
MOST = 1000

Limit = Annotated[int, Query(ge=1, le=MOST, description="items of this page, at most")]
IdCursor = Annotated[
    str | None,
    Query(
        pattern=r"^[0-9A-Za-z-]{1,40}$",
        description="the id of the last item of the page before; without it, the first page",
    ),
]
NumberCursor = Annotated[
    int | None,
    Query(ge=1, le=2**31 - 1, description="the id of the last item of the page before; without it, the first page"),
]

WordsOfName = Annotated[
    str, Query(max_length=200, description="only those whose name has each of these words, in either case")
]

#: OpenAPI's description of the headers that `page_headers` sets.
HEADERS = {
    "X-Total-Count": {"description": "how many items there are on all pages", "schema": {"type": "integer"}},
    "Link": {"description": 'the next page, rel="next", where there may be one', "schema": {"type": "string"}},
}


def page_headers(request: Request, response: Response, total: int, limit: int, ids: list[str]) -> None:
    """Say how many items there are, and where the next page is (RFC 8288). `ids`: those of this page."""
    response.headers["X-Total-Count"] = str(total)
    if len(ids) == limit:
        there = request.url.include_query_params(after=ids[-1])
        response.headers["Link"] = f'<{there.path}?{there.query}>; rel="next"'


def page_of(ids: list[str], after: str | None, limit: int, what: str) -> list[str]:
    """Return the ids of the page after a cursor, of a list that is all there.

    ids : the list
    after : id of the last one before the page; None: from the beginning
    limit : how many
    what : what they are, for the message

    Raises 422 for a cursor that isn't in the list.

    >>> page_of(["a", "b", "c"], "a", 1, "session")
    ['b']
    """
    if after is not None and after not in ids:
        raise HTTPException(422, f"after: no {what} {after!r}; begin without it")
    begin = ids.index(after) + 1 if after is not None else 0
    return ids[begin : begin + limit]
