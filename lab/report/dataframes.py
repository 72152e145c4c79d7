"""Results as tables: rows of plain values under names with units."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import singledispatch
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from lab.calibration.life import History
from lab.calibration.limits import figures_of
from lab.errors import InputError
from lab.formats.recording_set import RecordingSet
from lab.formats.results import (
    ComparisonResult,
    DiagnosisResult,
    Emva1288Points,
    FitResult,
    MtfCurve,
    PhotonTransfer,
    SpectralFit,
    ValidationResult,
)
from lab.twin.score import TwinScore
from lab.twin.sealed import SealedPrediction

if TYPE_CHECKING:
    import pandas as pd

#: A column's name -> its values.
Columns = dict[str, list[Any]]


def table(result: object) -> pd.DataFrame:
    """Return a result as a pandas table. Raises InputError where pandas isn't installed, or the result is no table."""
    try:
        import pandas as pd
    except ImportError as error:
        raise InputError("pandas isn't installed; pip install 'calibench[notebook]'") from error
    return pd.DataFrame(columns_of(result))


def _from_rows(rows: Iterable[Mapping[str, Any]], names: Iterable[str]) -> Columns:
    """Return rows as columns; the names stand where there are no rows, too."""
    listed = list(rows)
    return {name: [row.get(name) for row in listed] for name in names}


def _plain(item: BaseModel) -> dict[str, Any]:
    """Return those fields of an item that are one value each."""
    return {name: value for name, value in item if not isinstance(value, tuple | dict | BaseModel)}


def _plain_rows(items: Iterable[BaseModel]) -> Columns:
    """Return the plain fields of items as columns, without those that no item has."""
    rows = [_plain(item) for item in items]
    return _from_rows(rows, dict.fromkeys(name for row in rows for name, value in row.items() if value is not None))


def _parallel(item: BaseModel) -> Columns:
    """Return the sequences of an item that are as long as its longest, beside what is one value of all of them."""
    sequences = {name: list(value) for name, value in item if isinstance(value, tuple)}
    longest = max((len(values) for values in sequences.values()), default=0)
    columns: Columns = {}
    for name, value in item:
        if name in sequences:
            if len(sequences[name]) == longest:
                columns[name] = sequences[name]
        elif isinstance(value, str):
            columns[name] = [value] * longest
    return columns


@singledispatch
def columns_of(result: object) -> Columns:
    """Return the columns of a result. Raises InputError for what is no table."""
    raise InputError(f"{type(result).__name__}: is no table; take one of its parts")


@columns_of.register
def _(result: FitResult) -> Columns:
    """A row a figure: every fitted number that has a standard deviation."""
    rows = (
        {"side": figure.side, "figure": figure.name, "place": figure.place, "title": figure.title}
        | {"value": figure.value, "std": figure.std, "unit": figure.unit}
        for figure in figures_of(result)
    )
    return _from_rows(rows, ("side", "figure", "place", "title", "value", "std", "unit"))


@columns_of.register
def _(result: ValidationResult) -> Columns:
    return _plain_rows(result.checks)


@columns_of.register
def _(result: DiagnosisResult) -> Columns:
    """A row a parameter of each effect; of an effect without parameters, one row."""

    def rows() -> Iterator[dict[str, Any]]:
        for effect in result.effects:
            named: dict[str, Any] = {"effect": effect.name, "family": effect.family, "law": effect.law}
            named |= {"probability": effect.probability, "sides": ", ".join(effect.sides)}
            for name, value in effect.parameters.items():
                yield named | {"parameter": name, "value": value.value, "std": value.std, "unit": value.unit}
            if not effect.parameters:
                yield named

    names = ("effect", "family", "law", "probability", "sides", "parameter", "value", "std", "unit")
    return _from_rows(rows(), names)


@columns_of.register
def _(result: ComparisonResult) -> Columns:
    return _plain_rows(result.changes)


@columns_of.register
def _(result: History) -> Columns:
    return _plain_rows(result.points)


@columns_of.register
def _(result: SealedPrediction) -> Columns:
    rows = (
        {"side": side, "captures": " ".join(number.captures)} | _plain(number)
        for side, side_prediction in result.sides.items()
        for number in side_prediction.numbers
    )
    return _from_rows(rows, ("side", "quantity", "captures", "channel", "where", "x", "predicted", "std"))


@columns_of.register
def _(result: TwinScore) -> Columns:
    names = ("side", "quantity", "captures", "channel", "where", "x", "predicted", "std", "measured")
    rows = (_plain(number) | {"captures": " ".join(number.captures)} for number in result.numbers)
    return _from_rows(rows, (*names, "deviation", "deviation_sigma", "deviation_percent"))


@columns_of.register
def _(result: SpectralFit) -> Columns:
    columns: Columns = {"wavelength_nm": list(result.wavelength_nm)}
    for name in ("quantum_efficiency", "relative_sensitivity"):
        for end in ("", "_std"):
            for channel, values in getattr(result, f"{name}{end}").items():
                columns[f"{name}_{channel}{end}"] = list(values)
    return columns


@columns_of.register(MtfCurve)
@columns_of.register(PhotonTransfer)
@columns_of.register(Emva1288Points)
def _(result: BaseModel) -> Columns:
    return _parallel(result)


@columns_of.register
def _(result: RecordingSet) -> Columns:
    """A row a capture: what is stated of it."""
    return _plain_rows(result.captures())
