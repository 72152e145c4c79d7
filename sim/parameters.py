"""Where a physical parameter is declared: its unit, its bounds, its prior and what it means, once.

A model's field is annotated with a `Quantity`; fits, the REST schema, the pages and the documentation read it there:

    read_noise_e: Annotated[float, Quantity("e", "temporal noise of a dark pixel", lower=0, prior=(2.0, 5.0))]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema


class Frozen(BaseModel):
    """Base of every spec and result: immutable, and an unknown field is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __eq__(self, other: object) -> bool:
        """Equal fields: what a model has computed from them and kept (arrays, that compare to arrays) doesn't count."""
        if type(self) is not type(other):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in type(self).model_fields)

    def __hash__(self) -> int:
        return hash((type(self), *(getattr(self, name) for name in type(self).model_fields)))


@dataclass(frozen=True)
class Quantity:
    """Declaration of one physical parameter.

    `prior` is (centre, one standard deviation) of a normal distribution in the parameter's own unit, or None for a
    flat prior between the bounds. `absent` is the value that means that the effect isn't there. `linear_power` says in
    which power of the parameter the prediction has a slope at `absent`: 2 for a displacement d, which acts as d^2.
    `logarithmic`: positive, and fitted as its logarithm, as predictions depend on its product with another.
    `dispensable`: a refinement, that stays at `absent` where a fit without it is worth nearly as much. `smooth_over`:
    predictions follow the parameter smoothly over changes of this size, and unevenly over smaller ones. Of a tuple,
    each value is within the bounds.
    """

    unit: str
    meaning: str
    lower: float | None = None
    upper: float | None = None
    prior: tuple[float, float] | None = None
    absent: float | None = None
    linear_power: float = 1
    logarithmic: bool = False
    dispensable: bool = False
    smooth_over: float = 0.0

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        def check(value: Any) -> Any:
            for number in value if isinstance(value, tuple) else (value,):
                check_one(number)
            return value

        unit = "" if self.unit == "1" else f" {self.unit}"

        def check_one(value: Any) -> None:
            if isinstance(value, int | float):
                if self.lower is not None and value < self.lower:
                    raise ValueError(
                        f"{self.meaning}: {value}{unit} is below the lower limit {self.lower}{unit}; give a value "
                        "within the limits"
                    )
                if self.upper is not None and value > self.upper:
                    raise ValueError(
                        f"{self.meaning}: {value}{unit} is above the upper limit {self.upper}{unit}; give a value "
                        "within the limits"
                    )

        return core_schema.no_info_after_validator_function(check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        described = dict(handler(schema))
        described |= {"description": self.meaning, "unit": self.unit}
        bounds = {"minimum": self.lower, "maximum": self.upper}
        limits = {name: bound for name, bound in bounds.items() if bound is not None}
        if isinstance(described.get("items"), dict):  # several values: each has the bounds
            described["items"] = described["items"] | limits
            return described
        return described | limits


def read_quantities(model: type[BaseModel]) -> dict[str, Quantity]:
    """Field name -> its `Quantity`, for every field of `model` that declares one, in the order of declaration."""
    quantities: dict[str, Quantity] = {}
    for name, field in model.model_fields.items():
        for item in field.metadata:
            if isinstance(item, Quantity):
                quantities[name] = item
    return quantities
