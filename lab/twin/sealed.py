"""A sealed prediction: its file, canonical JSON, and beside it the SHA-256 of that file, as `sha256sum -c` reads it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Literal

from lab.capture_kinds.base import AnyCapture
from lab.errors import InputError
from lab.formats.raw_file import replacing
from lab.formats.recording_set import DataSheet
from lab.formats.result_file import read_result
from lab.formats.results import Skipped
from lab.shown import Tabular
from lab.twin.changes import Changes
from sim.camera import Side
from sim.parameters import Frozen


class TwinNumber(Frozen):
    """A predicted number: what is measured and where, its value and standard deviation.

    quantity : the measurement: `chart`, `noise` (a temporal variance), `slanted_edge` (an MTF), `dark`,
        `photon_transfer` (the mean of a flat)
    """

    quantity: str
    captures: tuple[str, ...]
    channel: str
    where: str
    x: float
    predicted: float
    std: float


class PredictedNumber(TwinNumber):
    """One number that will be measured, and how it follows what a session can't repeat exactly.

    fixed : the part that neither exposure nor temperature changes
    dark : the part by dark current, in proportion to the exposure, growing by exp(`warmth_per_c` x rise)
    level_dn, level_slope : of a variance: the mean signal above black that it is predicted for, and its derivative by
        that
    without_effects : of an edge: the same of the camera without effects. The estimator follows the samples of the
        recorded edge, so that the prediction moves by what this number is on the session's edge
    """

    fixed: float = 0.0
    dark: float = 0.0
    warmth_per_c: float = 0.0
    level_dn: float | None = None
    level_slope: float = 0.0
    without_effects: float | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """What the same number of a recording set has in common with it."""
        place = () if self.quantity in ("noise", "photon_transfer") else (self.where, round(self.x, 3))
        return self.quantity, self.captures, self.channel, *place


class PredictedRival(Frozen):
    """The numbers (n,) with a rival in the place of a named effect; `name` empty: with nothing there."""

    name: str
    probability: float
    numbers: tuple[float, ...]


class PredictedName(Frozen):
    """A name that the session will test: the effect in the model, as it was told (its name, or its family's), its
    probability among the rivals, and these."""

    effect: str
    told: str
    probability: float
    rivals: tuple[PredictedRival, ...]


class SidePrediction(Frozen):
    """The predictions of one camera. `covariance`: the lower triangle (n (n + 1) / 2), row by row, of noise and
    parameters together. `names`: what the session will say of each."""

    camera: DataSheet
    captures: tuple[AnyCapture, ...]
    lens: dict[str, float | None]
    numbers: tuple[PredictedNumber, ...]
    covariance: tuple[float, ...]
    names: tuple[PredictedName, ...] = ()
    skipped: tuple[Skipped, ...] = ()


class SealedPrediction(Tabular, Frozen):
    """What `calibench twin predict` writes."""

    format: Literal["calibench-twin"] = "calibench-twin"
    version: Literal[2] = 2
    model: str
    plan: str
    changes: Changes
    sides: dict[Side, SidePrediction]
    cameras: dict[Side, str]  # the changed camera models, as JSON


def seal_path(file: Path) -> Path:
    """Return the file beside a sealed one that holds its SHA-256.

    >>> seal_path(Path("prediction.json")).name
    'prediction.json.sha256'
    """
    return file.with_name(file.name + ".sha256")


def seal(prediction: SealedPrediction, file: Path) -> str:
    """Write a prediction as JSON, and its SHA-256 beside it; return the SHA-256 (hexadecimal).

    prediction : to be sealed before the session is captured
    file : JSON, to be written

    >>> from tempfile import TemporaryDirectory
    >>> prediction = SealedPrediction(model="left.toml", plan="my-plan", changes=Changes(), sides={}, cameras={})
    >>> with TemporaryDirectory() as folder:
    ...     digest = seal(prediction, Path(folder) / "prediction.json")
    ...     open_seal(Path(folder) / "prediction.json", digest).plan
    'my-plan'
    """
    text = (
        json.dumps(prediction.model_dump(mode="json"), sort_keys=True, separators=(",", ":"), ensure_ascii=True) + "\n"
    )
    digest = hashlib.sha256(text.encode()).hexdigest()
    for path, content in ((file, text), (seal_path(file), f"{digest}  {file.name}\n")):
        with replacing(path) as partial:
            partial.write_text(content, encoding="utf-8")
    return digest


def open_seal(file: Path, expected: str | None = None) -> SealedPrediction:
    """Read a sealed prediction. Raises InputError where its hash isn't `expected` (None: the one beside it)."""
    try:
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        sealed_digest = expected or seal_path(file).read_text(encoding="utf-8").split()[0]
    except (OSError, UnicodeDecodeError, IndexError) as error:
        raise InputError(f"{file}: it or its hash {seal_path(file).name} can't be read; give both files") from error
    if digest != sealed_digest.lower():
        raise InputError(
            f"{file}: was edited: its SHA-256 is {digest}, sealed was {sealed_digest}; take the file that was sealed"
        )
    return read_result(SealedPrediction, file)
