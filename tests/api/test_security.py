"""Protection of the service: scopes, cookies, Host, Origin, size limits, headers."""

from __future__ import annotations

import re
import socket
from typing import Any
from urllib.parse import urlsplit

import pytest

from api.failed_keys import ADDRESSES, FailedKeys, network_of
from api.keys import Permission, StoredKey, digest
from api.security import COOKIE, COOKIE_LIFETIME_S, Logins
from lab.capture.tables import JobRow
from lab.errors import InputError
from tests.api.conftest import Running, until, until_state

#: Every route under /api/v1 with the least scope that it needs.
ROUTES = [
    ("GET", "/me", "read"),
    ("GET", "/parameters", "read"),
    ("GET", "/effects", "read"),
    ("GET", "/effects/{name}", "read"),
    ("GET", "/stations", "read"),
    ("GET", "/devices", "operate"),
    ("GET", "/stations/{name}", "read"),
    ("GET", "/sequences", "read"),
    ("GET", "/sequences/{sequence}", "read"),
    ("POST", "/stations/{name}/estimate", "read"),
    ("GET", "/stations/{name}/devices", "read"),
    ("GET", "/stations/{name}/devices/{device}", "read"),
    ("POST", "/stations/{name}/devices/{device}/check", "operate"),
    ("GET", "/stations/{name}/devices/{device}/transcript", "read"),
    ("POST", "/stations/{name}/check", "operate"),
    ("POST", "/stations/{name}/put-back", "operate"),
    ("GET", "/sessions", "read"),
    ("POST", "/sessions", "operate"),
    ("GET", "/sessions/{session_id}", "read"),
    ("PATCH", "/sessions/{session_id}", "operate"),
    ("GET", "/sessions/{session_id}/request", "read"),
    ("PUT", "/sessions/{session_id}/request", "operate"),
    ("GET", "/sessions/{session_id}/figures", "read"),
    ("POST", "/sessions/{session_id}/pause", "operate"),
    ("POST", "/sessions/{session_id}/resume", "operate"),
    ("POST", "/sessions/{session_id}/abort", "operate"),
    ("POST", "/sessions/{session_id}/confirm", "operate"),
    ("GET", "/sessions/{session_id}/events", "read"),
    ("GET", "/sessions/{session_id}/captures", "read"),
    ("GET", "/sessions/{session_id}/captures/{capture_id}", "read"),
    ("GET", "/sessions/{session_id}/captures/{capture_id}/preview.{picture}", "read"),
    ("GET", "/sessions/{session_id}/captures/{capture_id}/frame.npy", "read"),
    ("GET", "/sessions/{session_id}/captures/{capture_id}/figures", "read"),
    ("GET", "/sessions/{session_id}/curves", "read"),
    ("DELETE", "/sessions/{session_id}", "admin"),
    ("GET", "/sessions/{session_id}/archive.{form}", "read"),
    ("GET", "/queue", "read"),
    ("PUT", "/sessions/{session_id}/queue", "operate"),
    ("DELETE", "/sessions/{session_id}/queue", "operate"),
    ("POST", "/halt", "operate or calibrate"),
    ("POST", "/sessions/{session_id}/jobs", "calibrate"),
    ("POST", "/pipelines", "admin"),
    ("GET", "/calibrations", "read"),
    ("GET", "/calibrations/{calibration_id}", "read"),
    ("POST", "/calibrations/{calibration_id}/certify", "calibrate"),
    ("GET", "/calibrations/{calibration_id}/figures", "read"),
    ("GET", "/calibrations/{calibration_id}/drafted-limits", "read"),
    ("GET", "/calibrations/{calibration_id}/certificate", "read"),
    ("GET", "/calibrations/{calibration_id}/certificate.json", "read"),
    ("POST", "/calibrations/{calibration_id}/revoke", "calibrate"),
    ("GET", "/drift", "read"),
    ("GET", "/figures", "read"),
    ("GET", "/history", "read"),
    ("GET", "/sessions/{session_id}/findings", "read"),
    ("GET", "/recordings/{recordings_id}/findings", "read"),
    ("GET", "/recordings", "read"),
    ("POST", "/recordings", "calibrate"),
    ("POST", "/foreign/spectra", "calibrate"),
    ("POST", "/foreign/table", "calibrate"),
    ("GET", "/recordings/{recordings_id}", "read"),
    ("GET", "/recordings/{recordings_id}/figures", "read"),
    ("GET", "/recordings/{recordings_id}/captures", "read"),
    ("GET", "/recordings/{recordings_id}/captures/{number}", "read"),
    ("GET", "/recordings/{recordings_id}/captures/{number}/preview.{picture}", "read"),
    ("GET", "/recordings/{recordings_id}/captures/{number}/frame.npy", "read"),
    ("GET", "/recordings/{recordings_id}/captures/{number}/figures", "read"),
    ("GET", "/recordings/{recordings_id}/archive.{form}", "read"),
    ("DELETE", "/recordings/{recordings_id}", "calibrate"),
    ("POST", "/recordings/{recordings_id}/jobs", "calibrate"),
    ("GET", "/jobs", "read"),
    ("GET", "/jobs/{job_id}", "read"),
    ("POST", "/jobs/{job_id}/cancel", "calibrate"),
    ("GET", "/jobs/{job_id}/events", "read"),
    ("GET", "/jobs/{job_id}/result", "read"),
    ("GET", "/jobs/{job_id}/report", "read"),
    ("GET", "/camera-models", "read"),
    ("GET", "/camera-models/{model_id}", "read"),
    ("POST", "/camera-models", "calibrate"),
    ("DELETE", "/camera-models/{model_id}", "calibrate"),
    ("GET", "/camera-models/{model_id}/archive.{form}", "read"),
    ("GET", "/camera-models/{model_id}/budget", "read"),
    ("GET", "/predictions", "read"),
    ("POST", "/predictions", "calibrate"),
    ("GET", "/predictions/{prediction_id}", "read"),
    ("GET", "/predictions/{prediction_id}/sealed.json", "read"),
    ("DELETE", "/predictions/{prediction_id}", "calibrate"),
    ("POST", "/predictions/{prediction_id}/score", "read"),
    ("GET", "/comparisons", "read"),
    ("GET", "/comparisons/page", "read"),
]
#: What can't be used as it is sent here: an empty upload, a query without its parameters.
UNUSABLE = {
    ("POST", "/recordings"),
    ("POST", "/foreign/spectra"),
    ("POST", "/foreign/table"),
    ("POST", "/camera-models"),
    ("GET", "/history"),
    ("GET", "/drift"),
    ("GET", "/comparisons"),
    ("GET", "/comparisons/page"),
    ("GET", "/camera-models/{model_id}/budget"),
}
BODIES: dict[str, Any] = {
    "/sessions": {"station": "nowhere"},
    "/sessions/{session_id}": {},
    "/pipelines": {"station": "nowhere"},
    "jobs": {"kind": "fit"},
    "/calibrations/{calibration_id}/certify": {},
    "/calibrations/{calibration_id}/revoke": {"why": "a test"},
    "/sessions/{session_id}/request": {"station": "nowhere"},
    "/sessions/{session_id}/confirm": {"target": "cap"},
    "/halt": {"station": "nowhere"},
    "/sessions/{session_id}/queue": {},
    "/stations/{name}/estimate": {},
    "/predictions": {"camera_model": "0" * 16, "plan": {"recordings_id": "0" * 16}},
    "/predictions/{prediction_id}/score": {"recordings_id": "0" * 16},
}


def test_the_list_of_routes_is_complete(shared: Running) -> None:
    paths = shared.app.openapi()["paths"]
    there = {
        (method.upper(), path) for path, methods in paths.items() for method in methods if path.startswith("/api/")
    }
    assert there == {(method, f"/api/v1{path}") for method, path, _ in ROUTES}


@pytest.mark.parametrize(("method", "path", "least"), ROUTES)
def test_each_route_needs_a_key_of_its_scope(shared: Running, method: str, path: str, least: str) -> None:
    ids = {
        "session_id": "0",
        "capture_id": "1",
        "number": "1",
        "job_id": "0" * 16,
        "recordings_id": "0" * 16,
        "calibration_id": "0" * 16,
        "name": "nothing",
        "device": "stage",
        "sequence": "nothing",
        "model_id": "0" * 16,
        "prediction_id": "0" * 16,
        "form": "tar",
        "picture": "png",
    }
    asked = "/api/v1" + re.sub(r"\{(\w+)\}", lambda found: ids[found[1]], path)
    body = BODIES.get(path, BODIES["jobs"] if path.endswith("/jobs") and method == "POST" else None)
    for scope, key in [(None, None), ("wrong", "calibench_" + "x" * 43), *shared.keys.items()]:
        with shared.client(None) as client:
            headers = {"Authorization": f"Bearer {key}"} if key else {}
            response = client.request(method, asked, json=body, headers=headers)
        if scope in (None, "wrong"):
            assert response.status_code == 401
            assert response.headers["www-authenticate"] == "Bearer"
        elif any(Permission(scope).allows(Permission(one)) for one in least.split(" or ")):
            # What is asked for isn't there, or can't be used: the key was good enough to be told so.
            assert response.status_code == (
                422 if (method, path) in UNUSABLE else 200 if "{" not in path and method == "GET" else 404
            )
        else:
            assert response.status_code == 403
            assert "needs " + " or ".join(f"'{one}'" for one in least.split(" or ")) in response.json()["detail"]


@pytest.mark.parametrize("header", ["Bearer", "Basic {}", "{}", "Bearer {}x", "Token {}", "Bearer {} {}"])
def test_other_ways_to_send_a_key_are_refused(shared: Running, header: str) -> None:
    with shared.client(None) as client:
        sent = header.replace("{}", shared.keys["admin"])
        assert client.get("/api/v1/me", headers={"Authorization": sent}).status_code == 401
        assert client.get("/api/v1/me", params={"key": shared.keys["admin"]}).status_code == 401
        assert client.get("/api/v1/me", headers={"Authorization": f"bearer {shared.keys['read']}"}).status_code == 200


def test_a_login_gives_a_cookie_that_scripts_and_other_sites_cannot_use(running: Running) -> None:
    with running.client(None) as client:
        assert client.post("/login", json={"key": "calibench_wrong"}).status_code == 401
        response = client.post("/login", json={"key": running.keys["operate"]})
        assert response.json() == {"name": "operate", "scope": "operate"}
        cookie = response.headers["set-cookie"].lower()
        assert "httponly" in cookie and "samesite=strict" in cookie and "path=/" in cookie
        assert running.keys["operate"].lower() not in cookie
        assert client.get("/api/v1/me").json()["name"] == "operate"
        # A header speaks for itself: a wrong key in it isn't mended by the cookie.
        assert client.get("/api/v1/me", headers={"Authorization": "Bearer wrong"}).status_code == 401
        kept = client.cookies[COOKIE]
        assert client.post("/logout").status_code == 204
        assert COOKIE not in client.cookies
        assert client.get("/api/v1/me", headers={"Cookie": f"{COOKIE}={kept}"}).status_code == 401


def test_a_removed_key_takes_its_logins_along(running: Running) -> None:
    with running.client(None) as client:
        client.post("/login", json={"key": running.keys["read"]})
        assert client.get("/api/v1/me").status_code == 200
        running.store.remove_key("read")
        assert client.get("/api/v1/me").status_code == 401


def test_logins_end_after_twelve_hours() -> None:
    clock = [0.0]
    logins = Logins(clock=lambda: clock[0])
    key = StoredKey("ada", Permission.READ, digest("x"))
    token = logins.open(key)
    clock[0] = COOKIE_LIFETIME_S - 1
    assert logins.holder(token) == key
    clock[0] = COOKIE_LIFETIME_S + 1
    assert logins.holder(token) is None
    logins.open(key)
    assert len(logins._tokens) == 1  # what has run out isn't kept


def test_an_address_is_blocked_after_too_many_failures_and_recovers() -> None:
    clock = [0.0]
    failed = FailedKeys(most=3, per_s=0.5, clock=lambda: clock[0])
    for _ in range(3):
        assert failed.wait_s("192.0.2.1") == 0
        failed.count_failure("192.0.2.1")
    assert failed.wait_s("192.0.2.1") == 2  # one comes back in 1 / 0.5 s
    assert failed.wait_s("192.0.2.2") == 0
    clock[0] = 2.0
    assert failed.wait_s("192.0.2.1") == 0
    clock[0] = 1000.0
    for _ in range(3):
        failed.count_failure("192.0.2.1")
    assert failed.wait_s("192.0.2.1") == 2  # no more than three were saved up


def test_a_client_with_a_whole_network_is_one_address() -> None:
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:1") != network_of("2001:db8:0:1::1")
    assert network_of("::ffff:192.0.2.1") == "192.0.2.1"
    failed = FailedKeys()
    for number in range(ADDRESSES + 50):
        failed.count_failure(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}")
    assert len(failed._left) == ADDRESSES  # no amount of addresses takes more memory


def test_guessing_is_slowed_down_and_valid_keys_are_not(running: Running) -> None:
    running.app.state.gate.failures = FailedKeys(most=5, per_s=0.01)
    with running.client("read") as client, running.client(None) as other:
        assert client.get("/api/v1/me").status_code == 200

        def guess(number: int) -> int:
            key = {"Authorization": f"Bearer calibench_{number:043d}"}
            if number % 3 == 0:
                return other.post("/login", json={"key": f"calibench_{number:043d}"}).status_code
            if number % 3 == 1:
                return other.post("/api/v1/sessions", json={}, headers=key | {"Idempotency-Key": "x"}).status_code
            return other.get("/metrics", headers=key).status_code

        assert [guess(number) for number in range(9)] == [401] * 5 + [429] * 4
        # Even the right key isn't looked at, so an answer tells nothing; one that was used before always is.
        right = {"Authorization": f"Bearer {running.keys['admin']}"}
        refused = other.get("/api/v1/me", headers=right)
        assert refused.status_code == 429 and 1 <= int(refused.headers["retry-after"]) <= 100
        assert client.get("/api/v1/me").status_code == 200
        running.app.state.gate.failures = FailedKeys()
        assert other.get("/api/v1/me", headers=right).status_code == 200


def test_no_answer_names_a_path_of_the_server(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that can go wrong with a path in its text, and every answer that would tell of it."""
    root = str(running.store.root)
    (running.store.root / "stations" / "broken.toml").write_text("name = [")
    stations = running.store.root / "stations"
    (stations / "lens.toml").write_text(
        (stations / "fakes.toml").read_text().replace("bit_depth = 12", 'bit_depth = 12, lens_file = "/srv/lab/x.zmx"')
    )

    def failing(*_: object, **__: object) -> None:
        raise OSError(13, "Permission denied", f"{root}/sessions/x/session.nxs")

    def refused(*_: object, **__: object) -> None:
        raise InputError(f"{root}/sessions/x/a.npy: damaged; see also /usr/lib/python3/thing.py and /dev/ttyUSB0")

    answers: list[str] = []
    with running.client() as client:
        started = client.post("/api/v1/sessions", json={"station": "fakes", "quick": True, "sequences": ["dark"]})
        path = started.headers["location"]
        until_state(client, started.json()["id"], "finished")
        for broken in (failing, refused):
            monkeypatch.setattr("lab.fit.fit_recording_set", broken)
            job = client.post(f"{path}/jobs", json={"kind": "fit"}).headers["location"]
            until(client, job, lambda now: now["state"] == "failed")
            answers += [client.get(job).text, client.get(f"{job}/result").text, client.get("/api/v1/jobs").text]
        assert "/dev/ttyUSB0" in answers[-1] and "sessions/x/a.npy" in answers[-1]
        running.store.add_result("fit", "x", {"source": f"{root}/recordings/0/set"}, job_id=job.rpartition("/")[2])
        with running.store.transaction() as db:
            db.get_one(JobRow, job.rpartition("/")[2]).state = "done"
        answers.append(client.get(f"{job}/result").text)
        assert "recordings/0/set" in answers[-1]
        for file in (running.store.folder(started.json()["id"])).glob("*.nxs"):
            file.write_bytes(b"damaged")
        capture = client.get(f"{path}/captures").json()[0]
        for asked in (capture["frame"], capture["preview"]):
            response = client.get(asked)
            assert response.status_code == 422
            answers.append(response.text)
        running.store.set_state(started.json()["id"], "failed", error=f"{root}/sessions/x: no space left")
        paths = (
            "/stations",
            "/sessions",
            path.removeprefix("/api/v1"),
            "/recordings",
            "/sessions?after=" + "/etc/x" * 9,
        )
        answers += [client.get(f"/api/v1{one}").text for one in paths]
        for station in ("broken", "lens"):
            answers.append(client.post("/api/v1/sessions", json={"station": station}).text)
    for answer in answers:
        found = re.findall(
            r"(?<![\w/])/(?:srv|usr|tmp|home|root|work|var|etc)/[^\s\"]*", answer.replace(running.url, "")
        )
        assert root not in answer and not found, (found, answer[:400])


# --- Host, Origin -----------------------------------------------------------------------------------------------------


def raw(running: Running, request: str) -> str:
    """The answer to bytes that no client library would send."""
    address = urlsplit(running.url)
    with socket.create_connection((address.hostname, address.port), timeout=10) as line:
        line.sendall(request.encode())
        answer = b""
        while chunk := line.recv(65536):
            answer += chunk
    return answer.decode(errors="replace")


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "localhost@evil.example:80", "", "[", "127.0.0.2"]
)
@pytest.mark.parametrize("path", ["/", "/health", "/api/v1/me"])
def test_a_foreign_host_is_refused(shared: Running, host: str, path: str) -> None:
    answer = raw(shared, f"GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n")
    assert answer.startswith("HTTP/1.1 400")
    assert "x-content-type-options: nosniff" in answer


@pytest.mark.parametrize("hosts", [["127.0.0.1", "evil.example"], ["evil.example", "127.0.0.1"], []])
def test_a_request_names_exactly_one_host(shared: Running, hosts: list[str]) -> None:
    lines = "".join(f"Host: {host}\r\n" for host in hosts)
    assert raw(shared, f"GET /health HTTP/1.1\r\n{lines}Connection: close\r\n\r\n").startswith("HTTP/1.1 400")


@pytest.mark.parametrize("host", ["127.0.0.1:9", "localhost", "LOCALHOST:1", "[::1]:80"])
def test_names_of_this_computer_pass(shared: Running, host: str) -> None:
    assert raw(shared, f"GET /health HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").startswith("HTTP/1.1 200")


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://[", ""])
def test_a_foreign_origin_changes_nothing(shared: Running, origin: str) -> None:
    with shared.client("admin") as client:
        headers = {"Origin": origin}
        assert client.post("/api/v1/sessions", json={"station": "nowhere"}, headers=headers).status_code == 403
        assert client.post("/login", json={"key": shared.keys["read"]}, headers=headers).status_code == 403
        assert client.get("/api/v1/me", headers=headers).status_code == 200
        own = client.post("/api/v1/sessions", json={"station": "nowhere"}, headers={"Origin": shared.url})
        assert own.status_code == 404  # heard, and there is no such station


def test_no_answer_invites_other_sites(shared: Running) -> None:
    with shared.client("admin") as client:
        asked = {"Origin": "https://evil.example", "Access-Control-Request-Method": "POST"}
        for response in (client.options("/api/v1/sessions", headers=asked), client.get("/api/v1/me", headers=asked)):
            assert not [name for name in response.headers if name.startswith("access-control")]


# --- headers and bodies -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/docs", "/health", "/static/operator.js", "/api/v1/me", "/nothing"])
def test_every_answer_has_the_security_headers(shared: Running, path: str) -> None:
    with shared.client(None) as client:
        headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["x-frame-options"] == "DENY"
    policy = headers["content-security-policy"]
    assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy and "unsafe" not in policy
    assert "server" not in headers or "uvicorn" in headers["server"]


def test_a_large_body_is_refused_stated_or_not(shared: Running) -> None:
    limit = shared.app.state.service.limits.body_bytes
    with shared.client("admin") as client:
        assert client.post("/api/v1/sessions", content=b" " * (limit + 1)).status_code == 413

        def chunks() -> Any:
            for _ in range(limit // 65536 + 2):
                yield b" " * 65536

        assert client.post("/api/v1/sessions", content=chunks()).status_code == 413
        assert client.post("/login", json={"key": "x" * 300}).status_code == 422


@pytest.mark.parametrize(
    "path",
    [
        "/static/../security.py",
        "/static/..%2fsecurity.py",
        "/static/%2e%2e/security.py",
        "/static//etc/passwd",
        "/static/operator.html",
        "/api/v1/sessions/..%2f..%2fregistry.sqlite",
        "/api/v1/sessions/%00",
        "/api/v1/sessions/0/captures/../../../keys",
        "/api/v1/jobs/..%2f..%2fregistry/report",
        "/api/v1/recordings/..",
        "/api/v1/recordings/..%2fstations",
        "/api/v1/recordings/%2e%2e%2fstations",
    ],
)
def test_no_path_leads_to_a_file(shared: Running, path: str) -> None:
    answer = raw(
        shared,
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {shared.keys['admin']}\r\nConnection: "
        "close\r\n\r\n",
    )
    assert answer.split()[1] in ("404", "422"), answer[:200]
    assert "root:" not in answer and "SQLite" not in answer and "import" not in answer
