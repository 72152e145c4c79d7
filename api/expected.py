"""What a request's body or query should have been: read from the OpenAPI description, for messages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from fastapi import Request
from starlette.routing import compile_path

_KINDS = {
    "string": "a text",
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
    "array": "a list",
    "object": "an object",
}
_EXAMPLES = {"string": "text", "integer": 1, "number": 1.5, "boolean": True, "array": [], "object": {}}


def paths_of(request: Request) -> list[str]:
    """Return the described paths that a request's path is one of."""
    return [path for path in request.app.openapi()["paths"] if compile_path(path)[0].match(request.url.path)]


class Expected:
    """The description of a request's route."""

    def __init__(self, request: Request) -> None:
        described = request.app.openapi()
        self._schemas = described["components"]["schemas"]
        methods = [described["paths"][path].get(request.method.lower(), {}) for path in paths_of(request)]
        self._operation: dict[str, Any] = next(filter(None, methods), {})

    @property
    def body(self) -> dict[str, Any] | None:
        """The schema of its JSON body; None where it takes none."""
        content = self._operation.get("requestBody", {}).get("content", {})
        return self._resolve(content["application/json"]["schema"]) if "application/json" in content else None

    def example(self) -> str:
        """Return an example of the body, as JSON."""
        return json.dumps(self._example_of(self.body or {}), ensure_ascii=False)

    def field(self, place: Sequence[int | str]) -> str:
        """Return what stands at a place (`body`, name, ...): of which kind, and an example."""
        schema = self._schema_at(place)
        if schema is None:
            return ""
        kind = _KINDS.get(schema.get("type", ""), "a value")
        if schema.get("format") == "date-time":
            kind = "a time with its zone"
        if "enum" in schema:
            kind = f"one of {', '.join(map(str, schema['enum']))}"
        name = next((step for step in reversed(place) if isinstance(step, str)), "")
        example = json.dumps(self._example_at(place, schema), ensure_ascii=False)
        shown = f'{{"{name}": {example}}}' if place[0] == "body" else f"{name}={str(example).strip(chr(34))}"
        return f"{kind}, such as {shown}"

    def names(self, place: Sequence[int | str]) -> tuple[str, ...]:
        """Return the names of the fields of the object at a place."""
        return tuple((self._schema_at(place) or {}).get("properties", {}))

    def _schema_at(self, place: Sequence[int | str]) -> dict[str, Any] | None:
        if place[0] == "query":
            for parameter in self._operation.get("parameters", ()):
                if parameter["in"] == "query" and parameter["name"] == place[-1]:
                    return self._resolve(parameter["schema"])
            return None
        schema = self.body
        for part in place[1:]:
            if schema is None:
                return None
            inner = schema.get("items") if isinstance(part, int) else schema.get("properties", {}).get(part)
            inner = inner or schema.get("additionalProperties")
            schema = self._resolve(inner) if isinstance(inner, dict) else None
        return schema

    def _resolve(self, schema: dict[str, Any]) -> dict[str, Any]:
        """Return a schema with its reference followed, and the first that isn't null of several."""
        if "$ref" in schema:
            return self._resolve(self._schemas[schema["$ref"].rpartition("/")[2]])
        for alternative in schema.get("anyOf", schema.get("oneOf", ())):
            if alternative.get("type") != "null":
                return self._resolve(alternative)
        return schema

    def _example_at(self, place: Sequence[int | str], schema: dict[str, Any]) -> Any:
        value: Any = (self.body or {}).get("example")
        for part in place[1:]:
            value = value.get(part) if isinstance(value, dict) else None
        return self._example_of(schema) if value is None else value

    def _example_of(self, schema: dict[str, Any]) -> Any:
        if "example" in schema or "enum" in schema:
            return schema["example"] if "example" in schema else schema["enum"][0]
        if schema.get("type") == "object" and schema.get("properties"):
            needed = schema.get("required") or list(schema["properties"])[:1]
            return {name: self._example_of(self._resolve(schema["properties"][name])) for name in needed}
        if schema.get("type") == "array" and isinstance(schema.get("items"), dict):
            return [self._example_of(self._resolve(schema["items"]))] * schema.get("minItems", 1)
        if schema.get("format") == "date-time":
            return "2030-01-01T12:00:00Z"
        return _EXAMPLES.get(schema.get("type", ""), "text")
