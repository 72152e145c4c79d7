"""Models of one family that a document's `kind` tells apart, as a type for a field of a pydantic model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, TypeVar, get_args

from pydantic import BaseModel, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

M = TypeVar("M", bound=BaseModel)
#: The registry's database keeps a kind in a column of so many characters.
LONGEST_NAME = 20


class ByKind(Generic[M]):
    """The models of one family, by the value of their field `kind`.

    As an annotation, `Annotated[Base, family]`, it validates a document by the model that its `kind` names. The family
    may grow after the annotated model was built.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self.models: dict[str, type[M]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """All kinds, in the order in which they were added."""
        return tuple(self.models)

    def add(self, model: type[M]) -> None:
        """Add a model. Its field `kind` is a `Literal` of one name. Raises ValueError where that name is taken or too
        long."""
        names = get_args(model.model_fields["kind"].annotation)
        if len(names) != 1 or not isinstance(names[0], str) or not 0 < len(names[0]) <= LONGEST_NAME:
            raise ValueError(
                f'{model.__name__}: write kind: Literal["NAME"], a name of {LONGEST_NAME} characters at most'
            )
        if self.models.setdefault(names[0], model) is not model:
            raise ValueError(f"{model.__name__}: the {self.what} kind {names[0]!r} is taken; choose another name")

    def parse(self, document: Mapping[str, Any]) -> M:
        """The model of a document. Raises ValueError for an unknown kind and `ValidationError` for wrong keys."""
        kind = document.get("kind")
        if kind not in self.models:
            raise ValueError(f"unknown kind {kind!r} of {self.what}; the kinds are {', '.join(self.models)}")
        return self.models[kind].model_validate(document)

    def _validated(self, value: Any) -> BaseModel:
        if isinstance(value, BaseModel):
            if type(value) in self.models.values():
                return value
            raise ValueError(f"{type(value).__name__} is no registered kind of {self.what}; register it")
        if not isinstance(value, Mapping):
            raise ValueError(f"isn't an object; write the {self.what}'s keys")  # noqa: TRY004  (pydantic reports ValueError)
        return self.parse(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self._validated, serialization=core_schema.simple_ser_schema("any")
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"oneOf": [handler(model.__pydantic_core_schema__) for model in self.models.values()]}
