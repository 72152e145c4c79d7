"""The REST service and the operator's page. Routes parse and call one function of `lab`; they share a `Service`."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import tempfile
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import HTMLResponse, PlainTextResponse
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from sqlalchemy.exc import SQLAlchemyError
from starlette.middleware import Middleware

from api import errors, schemas
from api.checks import DeviceChecks
from api.errors import DefectMiddleware, Problem, answers, problem
from api.idempotency import PARAMETER, Idempotency
from api.keys import LOOPBACK, Permission, create_halt_token, digest, halt_token_key, stored_keys
from api.known_queries import check_query
from api.live import LiveSessions
from api.metrics import CountedRequests, Metrics
from api.pictures import Pictures
from api.public_text import PublicText
from api.room_watch import RoomWatch
from api.routes import (
    calibrations,
    camera_models,
    findings,
    jobs,
    knowledge,
    queue,
    recordings,
    removed,
    sessions,
    twin,
)
from api.routes.stations import router as stations_router
from api.schemas import Health, Login, MayHalt, Me
from api.security import (
    COOKIE,
    HALT_COOKIE,
    Gate,
    SafeHeaders,
    SameHost,
    SmallBodies,
    TooManyFailures,
    address_of,
    set_cookies,
)
from api.service import READ, Here, Limits, Service
from api.shared_answers import Shared, SharedAnswers
from api.then import ThenRunner
from api.upload import Inbox
from api.waiting import QueueRunner
from lab.capture.recovery import Recovery
from lab.capture.session import Progress
from lab.capture.station import Drivers, Station, drivers_of
from lab.capture.store import Store
from lab.errors import CannotWrite, InputError, one_line
from lab.jobs import JobRunner
from lab.quick_look.process import QuickLook

log = logging.getLogger(__name__)
PREFIX = "/api/v1"
#: What takes archives, which may be larger than the memory.
ARCHIVES = frozenset((f"{PREFIX}/recordings", f"{PREFIX}/camera-models"))
PAGES = Path(__file__).parent / "pages"
ASSETS = {
    file.name: {".css": "text/css", ".js": "text/javascript"}[file.suffix]
    for file in sorted((*PAGES.glob("*.css"), *PAGES.glob("*.js")))
}
TAGS = [
    {"name": "access", "description": "Keys, logins, health."},
    {"name": "stations", "description": "Which instruments stand where."},
    {"name": "sessions", "description": "Capturing: start, queue, follow, pause, resume, abort, fetch, delete."},
    {"name": "captures", "description": "What was captured: pictures and raw frames."},
    {"name": "recordings", "description": "Recording sets that are sent in."},
    {"name": "jobs", "description": "Fits, validations, diagnoses, reports, whole pipelines."},
    {
        "name": "calibrations",
        "description": "Candidate, certified, superseded, expired; figures and their history; camera models; "
        "comparisons.",
    },
    {"name": "twin", "description": "Predictions before the capture, sealed; their scores, and budgets."},
    {"name": "knowledge", "description": "What the models know."},
]
#: Statuses that the service answers before a route is asked: a foreign Host, a method that the path hasn't, a body that
#: is too large, a foreign Origin; and a defect.
EVERYWHERE = (400, 405, 413, 500)
EVERY_CHANGE = (*EVERYWHERE, 403, 507)
open_to_all = APIRouter()


@open_to_all.get("/health", tags=["access"])
def health() -> Health:
    """Whether the service is up."""
    return Health(version=version("calibench"))


@open_to_all.get("/healthz", tags=["access"], responses=answers(503))
def ready(service: Here) -> Health:
    """Whether the service can work: its registry answers, its data folder takes files, and its disk has room. Else 503
    with the reason; halts, and what runs, don't need it. For a supervisor or a balancer."""
    try:
        service.store.under_way()
        with tempfile.TemporaryFile(dir=service.store.root):
            pass
        service.store.room.check()
    except CannotWrite as error:
        raise HTTPException(503, service.public(str(error))) from None
    except (OSError, SQLAlchemyError) as error:
        log.warning("not ready: %s", one_line(error))
        raise HTTPException(503, "the registry or the data folder can't be used; the service's log says more") from None
    return Health(version=version("calibench"))


@open_to_all.get(
    "/metrics", tags=["access"], dependencies=[READ], response_class=PlainTextResponse, responses=answers(401)
)
def metrics(request: Request) -> Response:
    """Requests, sessions and jobs, as Prometheus reads them. Needs a key, in Prometheus' `authorization`."""
    metrics: Metrics = request.app.state.metrics
    return Response(metrics.text(), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@open_to_all.post("/login", tags=["access"], responses=answers(401, 403, 413, 422, 429))
async def login(service: Here, request: Request, asked: Login, response: Response) -> Me:
    """Exchange a key for the page's cookies: that of the login, and one that allows a halt alone, also after the login
    has ended (see `GET /halt`). An address that sends too many wrong keys is answered 429 for a while."""
    key = await asyncio.to_thread(service.gate.check, asked.key.strip(), address_of(request))
    if key is None:
        raise HTTPException(401, "this key isn't valid; `calibench key create NAME` makes one")
    halt = None
    if key.scope is not Permission.READ:
        try:
            halt = await asyncio.to_thread(create_halt_token, service.store, key)
        except (
            InputError,
            CannotWrite,
            SQLAlchemyError,
        ) as error:  # a full disk: whoever is logged in halts with the login
            log.warning("no halt token for the page of %s: %s", key.name, one_line(error))
    set_cookies(response, service.gate.logins.open(key), halt, secure=request.url.scheme == "https")
    return Me(name=key.name, scope=key.scope)


@open_to_all.post("/logout", status_code=204, tags=["access"])
def logout(service: Here, request: Request, response: Response) -> None:
    """Forget the page's login, and that it may halt."""
    service.gate.logins.close(request.cookies.get(COOKIE, ""))
    if halt := request.cookies.get(HALT_COOKIE):
        with contextlib.suppress(InputError, CannotWrite, SQLAlchemyError):  # the browser forgets it in any case
            service.store.remove_halt_token(digest(halt))
    for name in (COOKIE, HALT_COOKIE):
        response.delete_cookie(name, path="/")


@open_to_all.get("/halt", tags=["access"])
def may_halt(service: Here, request: Request) -> MayHalt:
    """Whether this client may halt, by its key, its login or its halt token. Needs no key: for a page whose login has
    ended."""
    try:
        key = service.gate.identify_for_halt(request)
    except TooManyFailures:
        key = None
    return MayHalt(may_halt=key is not None and key.scope is not Permission.READ)


@open_to_all.get("/", include_in_schema=False)
def operator_page() -> HTMLResponse:
    """The operator's page."""
    return HTMLResponse((PAGES / "operator.html").read_text(encoding="utf-8"))


@open_to_all.get("/docs", include_in_schema=False)
def docs_page() -> HTMLResponse:
    """The routes, read from `/openapi.json`; nothing comes from elsewhere."""
    return HTMLResponse((PAGES / "docs.html").read_text(encoding="utf-8"))


@open_to_all.get("/static/{name}", include_in_schema=False)
def static_file(name: str) -> Response:
    """One of the pages' own files; looked up, never joined to a path."""
    if name not in ASSETS:
        raise HTTPException(404, "no such file")
    return Response((PAGES / name).read_bytes(), media_type=ASSETS[name], headers={"Cache-Control": "no-cache"})


@open_to_all.get("/favicon.ico", include_in_schema=False)
def favicon() -> Response:
    """There is no icon; browsers remember this answer for a day."""
    return Response(status_code=204, headers={"Cache-Control": "max-age=86400"})


def create_app(
    store: Store,
    *,
    stations: Path | None = None,
    hosts: Iterable[str] = (),
    webhook_hosts: Collection[str] = (),
    limits: Limits | None = None,
    connect: Callable[[Station], Drivers] = drivers_of,
    jobs_runner: JobRunner | None = None,
    recovery: Recovery | None = None,
) -> FastAPI:
    """Return the application on a store.

    `stations`: the folder of the station files, by default `stations` in the data folder. `hosts`: names under which
    the service is reached, beside this computer's own. `webhook_hosts`: those that may be notified of sessions' ends.
    `connect` makes a station's drivers. When the application ends, it cancels its jobs and aborts its sessions, which
    can be resumed; shutters are closed. `recovery` may have begun already; by default the application's start begins
    it.
    """
    folder = stations or store.root / "stations"
    folder.mkdir(parents=True, exist_ok=True)
    caps = limits or Limits()

    rescue, watch = recovery or Recovery(store, connect), RoomWatch(store)

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        rescue.resume_with(app.state.service.live.resume, app.state.service.live.safety.note_found)
        rescue.start()
        watch.start()
        app.state.service.waiting.start()
        app.state.service.then.start()
        yield
        await asyncio.to_thread(app.state.service.waiting.close)
        await asyncio.to_thread(app.state.service.then.close)
        await asyncio.to_thread(rescue.close)
        await asyncio.to_thread(app.state.service.checks.close)
        app.state.service.jobs.close()  # first: a job that captures ends its session itself
        app.state.service.live.close()
        app.state.service.quick_look.close()
        await asyncio.to_thread(watch.close)

    shared = Shared()
    live = LiveSessions(store, connect, shared.forget)
    gate = Gate(
        lambda anew: stored_keys(store, anew),
        store.knows_keys,
        halt_token_key=lambda sha256: halt_token_key(store, sha256),
    )
    jobs_of = jobs_runner or JobRunner(store)
    inbox = Inbox(store.root / "recordings")
    counted = Metrics({"sessions": store.count_states, "jobs": jobs_of.count_states})
    app = FastAPI(
        title="calibench",
        summary="Captures with, calibrates and explains cameras.",
        version=version("calibench"),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        swagger_ui_oauth2_redirect_url=None,
        openapi_tags=TAGS,
        license_info={"name": "BSD-3-Clause", "identifier": "BSD-3-Clause"},
        middleware=[
            Middleware(SafeHeaders),
            Middleware(CountedRequests, metrics=counted),
            Middleware(DefectMiddleware),
            Middleware(SameHost, hosts=LOOPBACK | frozenset(hosts)),
            Middleware(SharedAnswers, shared=shared, prefix=PREFIX, busy=lambda: live.any_runs, gate=gate),
            Middleware(SmallBodies, limit_bytes=caps.body_bytes, except_paths=ARCHIVES),
            Middleware(Idempotency, store=store, prefix=PREFIX, unread_paths=ARCHIVES),
        ],
    )
    app.state.gate = gate
    app.state.metrics = counted
    app.state.public = PublicText(store.root)
    app.state.service = Service(
        store=store,
        stations=folder,
        live=live,
        waiting=QueueRunner(store, live, lambda: rescue.settled),
        then=ThenRunner(store, live, jobs_of, webhook_hosts, shared.forget),
        quick_look=QuickLook(store),
        pictures=Pictures(store, inbox),
        jobs=jobs_of,
        inbox=inbox,
        gate=gate,
        public=app.state.public,
        limits=caps,
        checks=DeviceChecks(live, connect, store.root / "transcripts"),
        changed=shared.forget,
    )
    errors.install(app)

    def too_many(request: Request, error: Exception) -> Response:
        return problem(429, str(error), {"Retry-After": str(getattr(error, "wait_s", 60))})

    app.add_exception_handler(TooManyFailures, too_many)
    app.include_router(open_to_all)
    strict = [Depends(check_query)]
    app.include_router(stations_router, prefix=PREFIX, dependencies=strict)
    parts = (knowledge, sessions, queue, recordings, jobs, findings, calibrations, camera_models, twin, removed)
    for part in parts:
        app.include_router(part.router, prefix=PREFIX, dependencies=strict)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI schema, with the models of errors and events, which no route's return type names."""
    if app.openapi_schema is None:
        made = get_openapi(
            title=app.title,
            version=app.version,
            summary=app.summary,
            description=(
                "Errors have one line in `detail`: what, where, remedy. Keys go into the header "
                "`Authorization: Bearer KEY`, never into a URL. Times are UTC; a unit ends every number's name."
            ),
            routes=app.routes,
            tags=app.openapi_tags,
            license_info=app.license_info,
        )
        for path, operations in made["paths"].items():
            for method, operation in operations.items():
                if method == "post" and path.startswith(PREFIX):
                    operation.setdefault("parameters", []).append(PARAMETER)
                everywhere = EVERYWHERE if method == "get" else EVERY_CHANGE
                keyed = (429,) if operation.get("security") else ()
                for status, response in answers(*everywhere, *keyed).items():
                    operation["responses"].setdefault(str(status), response)
        known = made["components"]["schemas"]
        for model in (Problem, Progress, schemas.StoredSession, schemas.Job):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            for name, definition in schema.pop("$defs", {}).items():
                known.setdefault(name, definition)
            known.setdefault(model.__name__, schema)
        app.openapi_schema = made
    return app.openapi_schema
