"""A station, its devices and their self-tests, the catalogue of sequences, and what a session would take."""

from __future__ import annotations

import threading
from typing import Annotated

from fastapi import APIRouter, HTTPException, Response
from fastapi import Path as PathParameter
from fastapi.responses import PlainTextResponse

from api.errors import Conflict, answers, find_or_404
from api.routes.sessions import station_state
from api.schemas import ConnectedDevice, DeviceCheck, DeviceState, PlanAsked, StationState
from api.service import OPERATE, READ, Here, Service
from drivers import discovery
from drivers.errors import InstrumentError
from lab.capture.by_hand import left_by_hand, note_put_back
from lab.capture.catalogue import PlanEstimate, SequenceDescription, catalogue, describe_sequence, estimate, step_times
from lab.capture.station import Station
from lab.errors import DeviceError

router = APIRouter(tags=["stations"])
StationName = Annotated[str, PathParameter(max_length=100, description="of the station file, without `.toml`")]
DeviceName = Annotated[
    str, PathParameter(pattern=r"^[a-z]{1,40}(\.[a-z]{1,10})?$", description="`monochromator`, `cameras.left`, ...")
]


_LOOKING = threading.Lock()


@router.get("/devices", dependencies=[OPERATE], responses=answers(401, 403, 503))
def list_connected(service: Here) -> list[ConnectedDevice]:
    """What is connected to the service's computer, and what drives it, as `calibench devices` lists it: USB
    instruments, cameras of installed libraries, serial ports. Takes seconds where a network is searched for cameras."""
    try:
        with _LOOKING:  # the libraries that list cameras aren't made for two at a time
            return [
                ConnectedDevice(
                    address=instrument.address, what=service.public(instrument.what), driver=instrument.driver
                )
                for instrument in discovery.find_all()
            ]
    except InstrumentError as error:
        raise DeviceError(str(error)) from error


def _device(service: Service, name: str, station: Station, device: str) -> DeviceState:
    entry = station.devices.get(device)
    if entry is None:
        raise HTTPException(404, f"station {name!r} has no {device}; it has {', '.join(station.devices)}")
    latest = service.checks.latest(name, device)
    session_id = service.live.busy(station)
    state = "unknown" if latest is None else latest.state
    test = None if latest is None else latest.test
    family = "camera" if device.startswith("cameras.") else device
    return DeviceState(
        name=device,
        driver=f"{family}.{entry.driver}",
        address=service.public(entry.address),
        state="in use" if session_id is not None else state,
        used_by=session_id,
        checked=None if latest is None else latest.ended,
        identity=service.public(test.identity) if test else "",
        words=service.public(test.words) if test else "",
        transcript=f"/api/v1/stations/{name}/devices/{device}/transcript"
        if service.checks.transcript(name, device).is_file()
        else None,
    )


@router.get("/stations/{name}", dependencies=[READ], responses=answers(401, 404, 422))
def get_station(service: Here, name: StationName) -> StationState:
    """One station."""
    service.station_file(name)
    return station_state(service, name)


@router.post("/stations/{name}/put-back", dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422))
def put_back(service: Here, name: StationName) -> StationState:
    """Say that everything in `left_by_hand` is put back. Without that, the next session on these instruments asks for
    it. 409 while a session runs on them."""
    station = service.station(name)
    if (busy := service.live.busy(station)) is not None:
        raise Conflict(f"session {busy} runs on these instruments and puts back what it changes; wait for its end")
    for left in left_by_hand(service.store.root, station):
        note_put_back(service.store.root, left.session)
    return station_state(service, name)


@router.get("/stations/{name}/devices", dependencies=[READ], responses=answers(401, 404, 422))
def list_devices(service: Here, name: StationName) -> list[DeviceState]:
    """A station's instruments: where each is, what drives it, and how its latest self-test went. Nothing is asked of
    them."""
    station = service.station(name)
    return [_device(service, name, station, device) for device in station.devices]


@router.get("/stations/{name}/devices/{device}", dependencies=[READ], responses=answers(401, 404, 422))
def get_device(service: Here, name: StationName, device: DeviceName) -> DeviceState:
    """One instrument of a station."""
    return _device(service, name, service.station(name), device)


@router.get("/sequences", dependencies=[READ], responses=answers(401))
def list_sequences() -> list[SequenceDescription]:
    """The catalogue: what each sequence is for, what it needs, its parameters with unit and bounds."""
    return list(catalogue())


@router.get("/sequences/{sequence}", dependencies=[READ], responses=answers(401, 404, 422))
def get_sequence(sequence: str) -> SequenceDescription:
    """One sequence."""
    missing = f"no sequence {sequence[:60]!r}; GET /api/v1/sequences lists them"
    return find_or_404(missing, lambda: describe_sequence(sequence))


@router.post("/stations/{name}/estimate", dependencies=[READ], responses=answers(401, 404, 422))
def estimate_session(service: Here, name: StationName, asked: PlanAsked) -> PlanEstimate:
    """What a session would take on a station: each sequence with the values of its parameters, its captures and its
    time, learned from the sessions that the station has finished. Nothing is started."""
    station = service.station(name)
    return estimate(asked.plan(station), station, step_times(service.store, station))


@router.post(
    "/stations/{name}/devices/{device}/check",
    status_code=202,
    dependencies=[OPERATE],
    responses=answers(401, 403, 404, 409, 422),
)
def check_device(
    service: Here, name: StationName, device: DeviceName, response: Response, check: DeviceCheck | None = None
) -> DeviceState:
    """Let a device work once, as `calibench devices check` does: connect, identify, safe state, what it is for, safe
    state. It runs in the background, five minutes at most; `Location` says where to look. 409 while a session, or
    another check, has the station's instruments."""
    station = service.station(name)
    _device(service, name, station, device)
    service.checks.start(name, station, [device], check is not None and check.transcript)
    response.headers["Location"] = f"/api/v1/stations/{name}/devices/{device}"
    return _device(service, name, station, device)


@router.post(
    "/stations/{name}/check", status_code=202, dependencies=[OPERATE], responses=answers(401, 403, 404, 409, 422)
)
def check_station(
    service: Here, name: StationName, response: Response, check: DeviceCheck | None = None
) -> list[DeviceState]:
    """Let every device of a station work once, one after the other, as before a night: `Location` says where to look.
    409 while a session, or another check, has the station's instruments."""
    station = service.station(name)
    service.checks.start(name, station, list(station.devices), check is not None and check.transcript)
    response.headers["Location"] = f"/api/v1/stations/{name}/devices"
    return [_device(service, name, station, device) for device in station.devices]


@router.get(
    "/stations/{name}/devices/{device}/transcript",
    dependencies=[READ],
    response_class=PlainTextResponse,
    responses=answers(401, 404, 409, 422),
)
def device_transcript(service: Here, name: StationName, device: DeviceName) -> PlainTextResponse:
    """What went over a device's wire in the latest check that kept it: `>` sent, `<` received."""
    checked = _device(service, name, service.station(name), device)
    if checked.transcript is None:
        raise HTTPException(404, f'no transcript of {device} is kept; check it with {{"transcript": true}}')
    return PlainTextResponse(service.public.within(service.checks.transcript(name, device).read_text(encoding="ascii")))
