"""No request puts a control character into what is stored or logged, and a wrong request is answered in one line that
names the field, what is expected and an example."""

from __future__ import annotations

import json
import logging
import logging.config
from collections.abc import Iterator
from typing import Any

import pytest

from api.command import logging_config
from api.keys import EscapeControls
from lab.cli import main
from tests.api.conftest import Running

#: NUL, newline, ESC, DEL, CSI (C1), an override of the writing direction, half of a surrogate pair.
CONTROLS = ("\x00", "\n", "\x1b", "\x7f", "\x9b", "\u202e", "\ud800")
IDS = {
    "session_id": "20300101-120000-abcdef",
    "name": "fakes",
    "device": "stage",
    "sequence": "dark",
    "capture_id": "1",
    "number": "1",
    "side": "left",
    "form": "zip",
}


class Described:
    """The OpenAPI description, to make bodies from."""

    def __init__(self, app: Any) -> None:
        self.description = app.openapi()

    def resolved(self, schema: dict[str, Any]) -> list[dict[str, Any]]:
        """A schema with its references followed: one, or the alternatives."""
        if "$ref" in schema:
            return self.resolved(self.description["components"]["schemas"][schema["$ref"].rpartition("/")[2]])
        several = schema.get("anyOf", schema.get("oneOf"))
        return [one for part in several for one in self.resolved(part)] if several else [schema]

    def with_text(self, schema: dict[str, Any], text: str, depth: int = 6) -> Iterator[tuple[str, Any]]:
        """Documents of a schema that have `text` in one place, and where: in each field, item and free key."""
        if depth == 0:
            return
        for one in self.resolved(schema):
            kind = one.get("type")
            if kind == "string" and "enum" not in one and "const" not in one:
                yield "", text
            elif kind == "array":
                for place, inner in self.with_text(one.get("items", {}), text, depth - 1):
                    yield f"[0]{place}", [inner]
            elif kind == "object":
                for name, field in one.get("properties", {}).items():
                    for place, inner in self.with_text(field, text, depth - 1):
                        yield f".{name}{place}", {**one.get("example", {}), name: inner}
                more = one.get("additionalProperties")
                if isinstance(more, dict):
                    yield ".KEY", {text: {}}
                    for place, inner in self.with_text(more, text, depth - 1):
                        yield f".key{place}", {"key": inner}

    def bodies(self, text: str) -> Iterator[tuple[str, str, str, Any]]:
        """Method, path, place of the text and body, for all routes that take JSON."""
        for path, operations in self.description["paths"].items():
            for method, operation in operations.items():
                content = operation.get("requestBody", {}).get("content", {})
                if "application/json" in content:
                    for place, body in self.with_text(content["application/json"]["schema"], text):
                        yield method, path, place, body


def filled(path: str) -> str:
    for name, value in IDS.items():
        path = path.replace(f"{{{name}}}", value)
    head, *rest = path.split("{")
    return head + "".join("0123456789abcdef" + part.partition("}")[2] for part in rest)


@pytest.mark.parametrize("control", CONTROLS, ids=[f"U+{ord(one):04X}" for one in CONTROLS])
def test_no_text_of_any_request_has_a_control_character(shared: Running, control: str) -> None:
    """Every text field of every request's body, at any depth: 422, one line that names the character."""
    asked = 0
    with shared.client("admin") as client:
        for method, path, place, body in Described(shared.app).bodies(f"a{control}b"):
            if control == "\n" and place == ".notes":
                continue
            answer = client.request(
                method, filled(path), content=json.dumps(body), headers={"Content-Type": "application/json"}
            )
            where = f"{method} {path} {place}: {answer.status_code} {answer.text}"
            assert answer.status_code == 422, where
            detail = answer.json()["detail"]
            assert f"U+{ord(control):04X}" in detail and "\n" not in detail and control not in detail, where
            asked += 1
    assert asked > 30


def test_no_query_and_no_path_has_one(shared: Running) -> None:
    """Of every route: never a defect, never the character itself in the answer."""
    with shared.client("admin") as client:
        for path, operations in shared.app.openapi()["paths"].items():
            for name in [
                one["name"] for one in operations.get("get", {}).get("parameters", ()) if one["in"] == "query"
            ]:
                answer = client.get(filled(path), params={name: "a\x1bb\x00"})
                assert answer.status_code in (404, 422) and "\x1b" not in answer.text, (path, name, answer.text)
            if "{" in path:
                head = path.partition("{")[0]
                answer = client.get(f"{head}%1b%5b2J%00")
                assert answer.status_code in (404, 405, 422) and "\x1b" not in answer.text, (path, answer.text)


def test_notes_may_have_several_lines(shared: Running) -> None:
    with shared.client("admin") as client:
        made = client.post(
            "/api/v1/sessions", json={"station": "fakes", "notes": "cold\n\tday 1\r\nday 2", "queue": True}
        )
        assert made.status_code in (200, 201, 202), made.text
        id = made.json()["id"]
        assert client.get(f"/api/v1/sessions/{id}").json()["notes"] == "cold\n\tday 1\r\nday 2"
        assert client.patch(f"/api/v1/sessions/{id}", json={"name": "a\nb"}).status_code == 422


@pytest.mark.parametrize(
    ("path", "request_", "said"),
    [
        ("sessions", {"json": {}}, 'station: is missing; give a text, such as {"station": "bench"}'),
        ("sessions", {"json": 3}, "the body: isn't a JSON object; send one, such as {"),
        ("sessions", {}, "the body: is missing; send one, such as {"),
        ("sessions", {"content": b"station=bench"}, "with the header Content-Type: application/json (it is '')"),
        (
            "sessions",
            {"content": b'"\xff"', "headers": {"Content-Type": "application/json"}},
            "JSON in UTF-8; send one",
        ),
        (
            "sessions",
            {"json": {"station": "a", "nam": "x"}},
            "nam: there is no such field; those that there are: quick,",
        ),
        (
            "sessions",
            {"json": {"station": "a", "name": 3}},
            'name: 3 isn\'t taken; give a text, such as {"name": "after',
        ),
        ("sessions", {"json": {"station": "a", "name": "x" * 121}}, "name: 121 characters, 120 at most; shorten it"),
        (
            "sessions",
            {"json": {"station": "a", "not_before": "soon", "queue": True}},
            '"soon" isn\'t taken; give a time with its zone, such as {"not_before": "2030-01-01T12:00:00Z"}',
        ),
        (
            "sessions",
            {"json": {"station": "a", "parameters": {"dark": {"frames": None}}}},
            "parameters.dark.frames: null isn't a number; write one",
        ),
        (
            "sessions",
            {"json": {"station": "a", "not_before": "2999-01-01T00:00", "queue": True}},
            '"2999-01-01T00:00" has no time zone; give a time with its zone, such as {"not_before":',
        ),
        ("sessions", {"json": {"station": "a", "sequences": []}}, "sequences: 0 given, 1 at least; give a list, such"),
        (
            "sessions",
            {"json": {"station": "a", "then": {"webhook": "lab"}}},
            "then.webhook: 'lab' isn't the URL of a web server; give one, such as https://",
        ),
        (
            "predictions",
            {"json": {"camera_model": "0123456789abcdef", "plan": 3}},
            "plan: 3 isn't taken; give an object",
        ),
    ],
)
def test_a_wrong_request_is_answered_with_field_and_example(
    shared: Running, path: str, request_: dict[str, Any], said: str
) -> None:
    with shared.client("admin") as client:
        answer = client.post(f"/api/v1/{path}", **request_)
        detail = answer.json()["detail"]
        assert answer.status_code in (400, 422) and said in detail, detail
        assert "Input should" not in detail and "Field required" not in detail and "\n" not in detail


def test_a_foreign_origin_is_told_which_is_expected(shared: Running) -> None:
    with shared.client("admin") as client:
        answer = client.post("/api/v1/sessions", json={"station": "a"}, headers={"Origin": "http://elsewhere.example"})
        own = shared.url.removeprefix("http://")
        assert answer.status_code == 403
        assert (
            f"'http://elsewhere.example' isn't this service's, which is 'http(s)://{own}' here"
            in answer.json()["detail"]
        )


def test_a_key_that_was_sent_is_not_repeated(shared: Running) -> None:
    with shared.client(None) as client:
        for body in ({"key": "x" * 201}, {"key": ["secret-key"]}, {"key": 12345678}):
            answer = client.post("/login", json=body)
            assert answer.status_code == 422 and not any(one in answer.text for one in ("xxx", "secret", "12345"))


def test_names_of_before_are_escaped_on_the_terminal(shared: Running, capsys: pytest.CaptureFixture[str]) -> None:
    """Of sessions that an earlier version stored."""
    import sqlalchemy as sa

    with shared.client("admin") as client:
        id = client.post("/api/v1/sessions", json={"station": "fakes", "name": "old", "queue": True}).json()["id"]
    with shared.store.transaction() as db:
        db.execute(
            sa.text("UPDATE sessions SET name = :name WHERE id = :id"), {"name": "x\x1b[2J\x9b1m\u202e", "id": id}
        )
    assert main(["sessions", "--data", str(shared.store.root)]) == 0
    shown = capsys.readouterr().out
    assert "x\\x1b[2J\\x9b1m\\u202e" in shown and not any(one in shown for one in "\x1b\x9b\u202e")
    assert shared.store.recording_set(id).manifest.name == "x\\x1b[2J\\x9b1m\\u202e"


def test_a_log_has_none_either(capsys: pytest.CaptureFixture[str]) -> None:
    record = logging.LogRecord(
        "api", logging.INFO, "", 0, "%s: %s failed (%d)", ("a\x1b[2J\nb", ValueError("\x9bc"), 3), None
    )
    assert EscapeControls().filter(record)
    assert record.getMessage() == "a\\x1b[2J\\nb: \\x9bc failed (3)"
    assert all("escape" in handler["filters"] for handler in logging_config()["handlers"].values())
