"""Files of other programs that hold no recordings: read, and answered; nothing is kept."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import APIRouter, Query, Request

from api.errors import answers
from api.schemas import ForeignSpectra, SentSpectra, SentTable, TableFitted
from api.sending import BODY, Arrived, as_parameters, receive_archive
from api.service import CALIBRATE, Here
from api.unpacking import TooMuch
from api.upload import ForeignFile, located, name_as_in_archive
from lab.errors import InputError, NotDetermined
from lab.foreign_files import fit_table
from lab.formats.cgats import read_cgats

T = TypeVar("T")
router = APIRouter(tags=["recordings"], dependencies=[CALIBRATE])
REFUSALS = answers(401, 403, 413, 422, 503)


@router.post("/foreign/spectra", responses=REFUSALS, openapi_extra=BODY)
async def read_foreign_spectra(
    service: Here, request: Request, asked: Annotated[SentSpectra, Query()]
) -> ForeignSpectra:
    """The spectra of a CGATS file (.sp, .ti3, .txt) in a .zip, .tar or .tar.gz, as `calibench import --from spectra`
    reads them. Radiances are in W sr^-1 m^-2 nm^-1."""
    limit = service.limits.model_bytes

    def read(came: Arrived) -> ForeignSpectra:
        file = ForeignFile.unpacked(came.place, came.archive, limit).file(asked.path, (".sp", ".ti3", ".txt", ".cgats"))
        found = read_cgats(file)
        warnings = tuple(came.name_as_sent(f"{file}: {remark}") for remark in found.remarks)
        return ForeignSpectra(quantity=found.quantity, spectra=dict(found.spectra), warnings=warnings)

    async with receive_archive(service, request, limit) as came:
        return await asyncio.to_thread(_told, came, read)


@router.post("/foreign/table", responses=REFUSALS, openapi_extra=BODY)
async def fit_foreign_table(service: Here, request: Request, asked: Annotated[SentTable, Query()]) -> TableFitted:
    """The fit of a CSV of levels in a .zip, .tar or .tar.gz with its camera.toml, as `calibench import --from
    photon-transfer-table` and `spectral-table` make it."""
    limit = service.limits.model_bytes

    def fit(came: Arrived) -> TableFitted:
        sent = ForeignFile.unpacked(came.place, came.archive, limit)
        table = sent.file(asked.path, (".csv", ".txt", ".tsv"))
        made = fit_table(asked.format, table, located(sent.folder, "camera", asked.camera))
        return TableFitted(fit=made.fit, warnings=tuple(came.name_as_sent(remark) for remark in made.remarks))

    async with receive_archive(service, request, limit) as came:
        return await asyncio.to_thread(_told, came, fit)


def _told(came: Arrived, read: Callable[[Arrived], T]) -> T:
    """Return what `read` makes of an archive. Raises InputError, which names files as in the archive and options as
    parameters."""
    try:
        return read(came)
    except TooMuch:
        raise
    except (InputError, NotDetermined) as error:
        raise InputError(as_parameters(name_as_in_archive(str(error), came.place))) from None
