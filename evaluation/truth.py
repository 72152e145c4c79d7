"""The truth of a case, and its seal: a salted hash that fixes the truth before the diagnosis."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import tempfile
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel, ValidationError

from lab.errors import InputError
from sim.parameters import Frozen

#: Seeds below are for tuning, from here on for proofs; those of the everyday tests lie above both.
FIRST_PROOF_SEED = 1_000_000
FIRST_FRESH_SEED = 1 << 32
#: (rows, cols) of frames by the name of their size; None: each case has a frame of its own, see
#: `evaluation.draw.DrawnFrame.drawn`.
SIZES: dict[str, tuple[int, int] | None] = {
    "small": (96, 128),
    "medium": (192, 256),
    "full": (384, 512),
    "foreign": None,
}
Kind = Literal["healthy", "single", "compound", "outside"]
Purpose = Literal["tuning", "proof", "fresh"]
#: What is concealed: effects of the library, or laws that it doesn't have (`evaluation.unlisted`).
Laws = Literal["listed", "unlisted"]
Model = TypeVar("Model", bound=BaseModel)


class Concealed(Frozen):
    """One concealed law. Measures of its strength that are None weren't computed."""

    name: str
    effect: str | None = None  # its name in the library; None outside it
    variant: int = 0
    strength: float
    unit: str = "1"
    parameters: dict[str, float] = {}  # true values of the library's parameters that have the same meaning
    noncentrality: float  # of its change of the summaries (`evaluation.noncentrality`)
    conditional: float | None = None  # the part that the other concealed law can't imitate (`evaluation.noncentrality`)
    separability: float | None = None  # the part that no rival can imitate, either
    nearest_rival: str | None = None  # the rival that can imitate most of it


class CaseTruth(Frozen):
    """The truth of one case."""

    kind: Kind
    concealed: tuple[Concealed, ...] = ()
    fault: str | None = None  # name of the fault of metadata or rig
    accepts: tuple[str, ...] = ()  # effects whose names are right besides the concealed ones
    oracle_share: float | None = None  # share of draws of the noise in which the oracle is right; None: not computed
    cfa: str
    f_number: float
    frames: int
    rows: int
    cols: int
    recordings_sha256: str = ""  # over all files of the recording set, so that the seal fixes these, too

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the library of the concealed effects."""
        return tuple(c.effect for c in self.concealed if c.effect is not None)


class SaltedTruth(Frozen):
    """A truth with the salt of its seal."""

    salt: str
    truth: CaseTruth


class Truths(Frozen):
    """The truths of all cases, kept apart from the recordings."""

    format: Literal["calibench-truths"] = "calibench-truths"
    version: Literal[1] = 1
    purpose: Purpose
    seed: int
    size: str
    cases: int
    laws: Laws = "listed"
    truths: dict[str, SaltedTruth] = {}


class Seals(Frozen):
    """The seals beside the recordings: case -> SHA-256 of salt and truth. They reveal neither seed nor purpose."""

    format: Literal["calibench-seals"] = "calibench-seals"
    version: Literal[1] = 1
    seals: dict[str, str] = {}


def canonical(truth: CaseTruth) -> str:
    """JSON with sorted keys and no blanks, the same text for the same truth. Measures of strength that are None are
    left out, so that seals of older cases, which had none, still hold."""
    content = truth.model_dump(mode="json")
    for part in (content, *content["concealed"]):
        for name in ("oracle_share", "conditional", "separability", "nearest_rival"):
            if part.get(name) is None:
                part.pop(name, None)
    return json.dumps(content, sort_keys=True, separators=(",", ":"))


def seal(salted: SaltedTruth) -> str:
    """SHA-256 (hex) of the salt followed by the canonical truth."""
    return hashlib.sha256((salted.salt + canonical(salted.truth)).encode()).hexdigest()


def salted(truth: CaseTruth) -> SaltedTruth:
    """Return a truth with a random salt of 128 bits, so that its seal can't be guessed from the few likely truths."""
    return SaltedTruth(salt=secrets.token_hex(16), truth=truth)


def digest(folder: Path) -> str:
    """SHA-256 over names and contents of all files of a folder, in the order of their names."""
    total = hashlib.sha256()
    for file in sorted(p for p in folder.rglob("*") if p.is_file()):
        total.update(f"{file.relative_to(folder).as_posix()}\0{file.stat().st_size}\0".encode())
        total.update(file.read_bytes())
    return total.hexdigest()


def purpose_of(seed: int) -> Purpose:
    """Return what cases of a seed are for: tuning, a proof, or everyday tests (fresh)."""
    return "tuning" if seed < FIRST_PROOF_SEED else "proof" if seed < FIRST_FRESH_SEED else "fresh"


def load(model: type[Model], file: Path) -> Model:
    """Return a model from a JSON file. Raises InputError where it can't be read or isn't valid."""
    try:
        return model.model_validate_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: can't be read ({error.strerror}); give the file that `make` wrote") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{file}: {where or 'the text'}: {first['msg']}; take the file that `make` wrote") from error


def store(model: BaseModel, file: Path, *, mode: int = 0o644) -> None:
    """Write a model as JSON, completely or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
    with os.fdopen(handle, "w", encoding="utf-8") as stream:
        stream.write(model.model_dump_json(indent=1) + "\n")
    Path(partial).chmod(mode)
    Path(partial).replace(file)
