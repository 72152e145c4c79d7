"""What the benchmark of real recordings declares of each set: how it is brought in, and what was found in it by other
means.

`sets.toml` has a table a set of the shared data. A folder that is named may hold further sets: each in a folder of its
own, with such a table as `independent.toml` beside the recordings where there is one.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Literal

from pydantic import ValidationError, model_validator

from lab.errors import InputError
from sim.parameters import Frozen

DECLARED = Path(__file__).with_name("sets.toml")
#: Beside the recordings of a set that `sets.toml` doesn't have.
BESIDE = "independent.toml"
#: Commands that turn another format into a recording set take these; "table": no frames, its import is a fit.
TABLE = "spectral-table"


class Figure(Frozen):
    """A figure by other means: a program, numpy, a published value or the truth of a simulation.

    `at`: its place in the results, see `found_at`. `std`: standard uncertainty of `value`.
    """

    name: str
    at: str
    value: float
    std: float
    unit: str = "1"


class DeclaredSet(Frozen):
    """A set: where it is, how it is imported, and what an independent look found.

    path       below the folder of all sets; None: the set's name; empty: `prepare` records it
    prepare    a script of docs/ that is run with the recordings and a folder to write, and `part` of what it writes
    importer   KIND of `calibench import --from`; empty: a recording set
    camera     what `camera.toml` would say, of a single picture
    figures    independent figures
    undetermined  places of figures that these recordings can't determine: one that is given is made up
    agrees     names of effects or families that an independent look confirms, and why
    contradicted  names that it contradicts, and why
    others     what any other name is
    expected   of `agrees`, the names that have to be given
    is_small   whether it is part of the everyday tests: three seconds of CPU at most
    """

    title: str
    story: str = ""
    path: str | None = None
    prepare: str = ""
    part: str = ""
    importer: str = ""
    checkerboard: tuple[int, int] | None = None
    square_mm: float | None = None
    exposure_s: float | None = None
    transfer: Literal["linear", "srgb"] | None = None
    channel: str | None = None
    camera: str = ""
    figures: tuple[Figure, ...] = ()
    undetermined: tuple[str, ...] = ()
    agrees: dict[str, str] = {}
    contradicted: dict[str, str] = {}
    others: Literal["not known", "contradicted"] = "not known"
    expected: tuple[str, ...] = ()
    is_small: bool = False

    @model_validator(mode="after")
    def _check(self) -> DeclaredSet:
        strange = sorted({*self.expected} - {*self.agrees})
        if strange:
            raise ValueError(f"expected {strange[0]}: not among the names that an independent look agrees with")
        return self

    def brought_in(self) -> str:
        """All that the results depend on, as JSON."""
        told = {"title", "story", "figures", "undetermined", "agrees", "contradicted", "others", "expected", "is_small"}
        return self.model_dump_json(exclude=told)


def declared_sets(file: Path = DECLARED) -> dict[str, DeclaredSet]:
    """Sets by name, in the order of the file. Raises InputError where it isn't valid."""
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    return {name: _valid(table, f"{file}: {name}") for name, table in tables.items()}


def sets_in(folder: Path) -> dict[str, DeclaredSet]:
    """The sets in the folders of `folder`, by the folder's name: what `independent.toml` declares, else recording sets,
    folders of frames with an index, and EMVA 1288 sessions."""
    found = {}
    for inside in sorted(path for path in folder.iterdir() if path.is_dir()):
        beside = inside / BESIDE
        if beside.is_file():
            table = {"title": inside.name} | tomllib.loads(beside.read_text(encoding="utf-8"))
            found[inside.name] = _valid(table | {"path": f"{inside.name}/{table.get('path', '')}"}, str(beside))
            continue
        kinds = {"manifest.json": "", "index.csv": "raw-folder", "EMVA1288_Data.txt": "emva1288"}
        kind = next((kind for name, kind in kinds.items() if (inside / name).is_file()), None)
        if kind is not None:
            found[inside.name] = DeclaredSet(title=inside.name, path=inside.name, importer=kind)
    return found


def _valid(table: object, where: str) -> DeclaredSet:
    try:
        return DeclaredSet.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{where}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
