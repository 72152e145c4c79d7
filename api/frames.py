"""Answers with what is seen of one capture: its picture and its raw frame. A capture never changes."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query, Request, Response

from api.preview import Form
from api.service import Service
from lab.capture.durable_files import npy_bytes

#: A capture's path has its session's random id in it.
FOR_EVER = {"Cache-Control": "private, max-age=31536000, immutable"}
Width = Annotated[int, Query(ge=16, le=4096, description="px, at most")]
Stretch = Annotated[bool, Query(description="white is the frame's own brightest, not the data sheet's")]


class Picture(Response):
    media_type = "image/png"


class Npy(Response):
    media_type = "application/x-npy"


def picture_of(
    service: Service, request: Request, source: str, capture_id: int, form: Form, width_px: int, stretch: bool
) -> Response:
    """Return a capture's picture; 304 where the client has it."""
    tag = f'"{source}-{capture_id}-{width_px}-{int(stretch)}-{form}"'
    headers = FOR_EVER | {"ETag": tag}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=headers)
    content = service.pictures.picture(source, capture_id, width_px, stretch, form)
    return Picture(content, headers=headers, media_type=f"image/{form}")


def npy_of(service: Service, source: str, capture_id: int) -> Response:
    """Return a capture's raw frame as .npy."""
    headers = FOR_EVER | {"Content-Disposition": f'attachment; filename="capture-{capture_id}.npy"'}
    return Npy(npy_bytes(service.pictures.frame(source, capture_id)), headers=headers)
