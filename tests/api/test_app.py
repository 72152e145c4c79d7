"""The application: its schema, its pages, its errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from api.app import ASSETS, PAGES, TAGS
from lab.errors import DeviceError
from tests.api.conftest import Running


def test_health_needs_no_key(shared: Running) -> None:
    with shared.client(None) as client:
        assert client.get("/health").json()["status"] == "ok"


def test_ready_only_while_the_data_folder_takes_files(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    with running.client(None) as client:
        assert client.get("/healthz").json()["status"] == "ok"

        def full(**_: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("api.app.tempfile.TemporaryFile", full)
        response = client.get("/healthz")
        assert response.status_code == 503 and "data folder" in response.json()["detail"]


def test_metrics_count_requests_by_route_and_sessions_by_state(shared: Running) -> None:
    with shared.client("read") as client:
        assert client.get("/api/v1/sessions/none").status_code == 404
        assert client.get("/no/such/page").status_code == 404
        text = client.get("/metrics").text
    assert 'calibench_sessions{state="finished"} 1.0' in text
    route = re.search(r'calibench_requests_total\{method="GET",route="([^"]*session_id[^"]*)",status="404"\} 1.0', text)
    assert route is not None and "none" not in route[1]
    assert "calibench_first_byte_seconds_bucket" in text and "/no/such/page" not in text
    with shared.client(None) as client:
        assert client.get("/metrics").status_code == 401


def test_errors_are_problem_details_without_a_path_of_the_server(shared: Running) -> None:
    with shared.client("read") as client:
        for path, status in (("/api/v1/jobs/" + "0" * 16, 404), ("/nothing", 404), ("/api/v1/jobs?after=x", 422)):
            response = client.get(path)
            assert response.status_code == status and response.headers["content-type"] == "application/problem+json"
            found = response.json()
            assert set(found) == {"type", "title", "status", "detail"} and found["status"] == status
            assert str(shared.store.root) not in found["detail"] and found["detail"]


@pytest.mark.parametrize("unknown", ["nope", "Nothing of the kind", "-1", "x" * 120])
def test_what_a_path_names_and_is_not_there_is_404_in_a_plain_sentence(shared: Running, unknown: str) -> None:
    asked = 0
    with shared.client("admin") as client:
        for method, path, described in operations(shared):
            if not path.startswith("/api/") or "{" not in path:
                continue
            there = re.sub(r"\{\w+\}", unknown, path.replace("{form}", "zip"))
            body = {"kind": "fit"} if path.endswith("/jobs") else {} if "requestBody" in described else None
            body = {"station": "fakes"} if path.endswith("/request") and body is not None else body
            body = {"target": "cap"} if path.endswith("/confirm") else body
            response = client.request(method, there, json=body)
            assert (response.status_code, response.headers["content-type"]) == (404, "application/problem+json"), there
            said = response.json()["detail"]
            assert "pattern" not in said and unknown[:20] in said and "/api/v1/" in said and "{" not in said, (
                there,
                said,
            )
            assert "404" in described["responses"]
            asked += 1
    assert asked > 40


def test_an_id_that_is_none_is_told_so_in_a_plain_sentence(shared: Running) -> None:
    with shared.client("read") as client:
        for path in ("/api/v1/jobs?after=no_id", "/api/v1/comparisons?a=no_id&b=0"):
            response = client.get(path)
            said = response.json()["detail"]
            assert response.status_code == 422 and "'no_id' is no id" in said and "^" not in said


def operations(shared: Running) -> list[tuple[str, str, dict[str, Any]]]:
    paths = shared.app.openapi()["paths"]
    return [(method, path, one) for path, methods in paths.items() for method, one in methods.items()]


def test_every_route_says_what_it_answers(shared: Running) -> None:
    tags = {tag["name"] for tag in TAGS}
    for method, path, one in operations(shared):
        where = f"{method} {path}"
        assert one["description"], where
        assert set(one["tags"]) <= tags and one["tags"], where
        good = [one["responses"][status] for status in one["responses"] if status.startswith("2")]
        assert len(good) == 1, where
        if "204" in one["responses"]:
            continue
        for kind, content in good[0]["content"].items():
            pictures_and_files = ("image/png", "image/webp", "application/x-npy", "application/zip")
            assert kind in pictures_and_files or content["schema"], where
        for status, answer in one["responses"].items():
            if status.startswith("4"):
                assert answer["content"]["application/problem+json"]["schema"] == {
                    "$ref": "#/components/schemas/Problem"
                }, where


def test_all_but_logins_and_health_state_their_security(shared: Running) -> None:
    schemes = shared.app.openapi()["components"]["securitySchemes"]
    assert schemes["key"]["scheme"] == "bearer" and schemes["login"]["in"] == "cookie"
    assert schemes["halt"]["in"] == "cookie"
    for _, path, one in operations(shared):
        wanted = [{"key": []}, {"login": []}] if path.startswith("/api/") or path == "/metrics" else None
        if path == "/api/v1/halt" and wanted is not None:
            wanted = [*wanted, {"halt": []}]
        assert one.get("security") == wanted, path


def test_the_schema_is_closed(shared: Running) -> None:
    """Every reference leads somewhere, every operation has an id of its own, every path parameter is declared."""
    schema = shared.app.openapi()
    assert schema["openapi"].startswith("3.1")

    def references(of: Any) -> list[str]:
        if isinstance(of, dict):
            here = [of["$ref"]] if isinstance(of.get("$ref"), str) else []
            return here + [one for value in of.values() for one in references(value)]
        return [one for value in of for one in references(value)] if isinstance(of, list) else []

    models = schema["components"]["schemas"]
    assert {one.removeprefix("#/components/schemas/") for one in references(schema)} <= set(models)
    assert "HTTPValidationError" not in models
    ids = [one["operationId"] for _, _, one in operations(shared)]
    assert len(ids) == len(set(ids))
    for method, path, one in operations(shared):
        stated = {p["name"] for p in one.get("parameters", []) if p["in"] == "path"}
        assert stated == set(re.findall(r"\{(\w+)\}", path)), f"{method} {path}"


def test_results_are_described_by_the_models_of_the_command_line(shared: Running) -> None:
    answer = shared.app.openapi()["paths"]["/api/v1/jobs/{job_id}/result"]["get"]["responses"]["200"]
    named = {one["$ref"].rpartition("/")[2] for one in answer["content"]["application/json"]["schema"]["anyOf"]}
    assert named == {"FitResult", "ValidationResult", "DiagnosisResult", "PipelineResults"}


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_pages_need_nothing_from_elsewhere(shared: Running, path: str) -> None:
    with shared.client(None) as client:
        page = client.get(path).text
        named = re.findall(r'(?:src|href)="([^"]+)"', page)
        loaded = [one for one in named if not one.startswith("#")]  # those are views of the page itself
        assert loaded and all(one.startswith("/") and not one.startswith("//") for one in loaded)
        for one in loaded:
            assert client.get(one).status_code == 200, one
    assert "<script>" not in page and "style=" not in page and " onclick=" not in page  # the policy forbids inline code


def test_static_files_are_those_of_the_folder() -> None:
    there = {file.name for file in PAGES.iterdir() if file.suffix in (".css", ".js")}
    assert there == set(ASSETS)
    for name in there:
        assert not re.search(r"https?://", (PAGES / name).read_text()), name


def test_no_swagger_from_a_cdn(shared: Running) -> None:
    with shared.client(None) as client:
        assert client.get("/redoc").status_code == 404
        assert "cdn" not in client.get("/docs").text


def test_errors_are_one_line(shared: Running) -> None:
    with shared.client("admin") as client:
        for response, status in [
            (client.post("/api/v1/sessions", json={"station": 5, "x": 1}), 422),
            (client.post("/api/v1/sessions", content=b"{"), 422),
            (client.get("/api/v1/sessions/none"), 404),
            (client.get("/nothing"), 404),
            (client.put("/api/v1/sessions"), 405),
        ]:
            assert response.status_code == status
            assert isinstance(response.json()["detail"], str) and "\n" not in response.json()["detail"]
        broken = client.post("/api/v1/sessions", content=b'{"station":', headers={"Content-Type": "application/json"})
        assert broken.json()["detail"] == "the body isn't JSON: Expecting value, at character 11"
        said = client.post("/api/v1/sessions", json={"station": "fakes", "colour": "red"}).json()["detail"]
        assert "colour" in said


def test_a_device_that_fails_is_503_and_a_defect_500(
    shared: Running, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(error: Exception) -> Any:
        def sessions(*_: Any, **__: Any) -> Any:
            raise error

        return sessions

    with shared.client("admin") as client:
        monkeypatch.setattr(type(shared.store), "sessions", failing(DeviceError("lamp: out\nburnt")))
        response = client.get("/api/v1/sessions")
        assert (response.status_code, response.json()["detail"]) == (503, "lamp: out; burnt")
        monkeypatch.setattr(type(shared.store), "sessions", failing(KeyError(str(Path("/secret/place")))))
        response = client.get("/api/v1/sessions")
        assert response.status_code == 500
        assert "secret" not in response.text and response.headers["x-content-type-options"] == "nosniff"
        assert "secret" in caplog.text


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"station": "fakes", "sequences": ["magic"]}, "sequences.0: 'magic' is no sequence; choose from dark,"),
        ({"station": "fakes", "not_before": "2030-01-01T00:00:00Z"}, "not_before: goes with queue = true; give both"),
        ({"station": "fakes", "quick": 7}, "quick: 7 isn't true or false; write one of them, without quotes"),
    ],
)
def test_a_refusal_names_the_field_and_its_value_once(shared: Running, body: dict[str, Any], said: str) -> None:
    with shared.client() as client:
        detail = client.post("/api/v1/sessions", json=body).json()["detail"]
        assert detail.startswith(said) and "Value error" not in detail and "; sequences: " not in detail, detail
        missing = client.get("/api/v1/nothing").json()
        assert missing["status"] == 404 and "/docs" in missing["detail"]
