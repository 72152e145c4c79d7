"""Limits that a laboratory sets on figures of a calibration: a good and a warning band each.

A figure is judged by its value and its uncertainty, as ISO 14253-1 decides conformity: `good` where the whole interval
of value
+- 2 standard deviations lies in the good band, `warn` where it lies in the warning band, else `bad`. A figure without a
stated uncertainty is judged by its value alone. A limit whose figure the calibration doesn't have is `missing`.

    valid_days = 90
    [[limit]]
    figure = "noise read_noise_e"     # as `calibench compare` names it; * stands for any text
    side = "left"                     # or left out: both cameras
    good = [0.0, 2.5]
    warn = [0.0, 3.0]"""

from __future__ import annotations

import math
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, ValidationError, model_validator

from lab.errors import InputError
from lab.fit.compare import FEW, numbers_of, place_of
from lab.fit.noise.dark_current import SensorTemperature
from lab.formats.results import FitResult
from lab.formats.results.words import plain_name, unit_of
from lab.formats.toml_file import read_toml
from sim.camera import Side
from sim.parameters import Frozen

# ----------------------------------------------------------------------------------------------------------------------
# The figures of a calibration: every number of a fit that has a standard deviation, by the name that `compare` gives
# it.
#
# Curves and kernels are left out: they have no single value that a limit could bound. What is read off them (MTF50) is
# there.


class Figure(Frozen):
    """One number of a calibration. `side` None: of the pair; `place`: which of several numbers under one name (`fx`),
    else empty. `sensor`: of a dark current, at which temperature it was measured."""

    name: str
    side: Side | None = None
    place: str = ""
    value: float
    std: float
    sensor: SensorTemperature | None = None

    @property
    def title(self) -> str:
        """The plain name: `focal length x`, `dark current at 31.0 °C`."""
        name = plain_name(self.name, self.place)
        return name if self.sensor is None else f"{name} {self.sensor.text}"

    @property
    def unit(self) -> str:
        """The unit, "1" for a ratio."""
        return unit_of(self.name)


def figures_of(fit: FitResult) -> tuple[Figure, ...]:
    """Return all figures of a fit with a standard deviation, each once.

    >>> from lab.formats.results import CameraFit, FitResult, NoiseFit
    >>> noise = NoiseFit(read_noise_e=2.0, read_noise_e_std=0.1)
    >>> fit = FitResult(source="my-camera", cameras={"left": CameraFit(noise=noise)})
    >>> [(figure.name, figure.value) for figure in figures_of(fit)]
    [('noise read_noise_e', 2.0)]
    """
    figures: list[Figure] = []
    models = [(side, camera, "") for side, camera in fit.cameras.items()]
    parts = [*models, (None, fit.stereo, "stereo ")] if fit.stereo is not None else models
    for side, model, prefix in parts:
        for name, numbers in numbers_of(model, prefix):
            if numbers.value.size > FEW:
                continue
            for at, (value, std) in enumerate(zip(numbers.value.ravel(), numbers.std.ravel(), strict=True)):
                if abs(value) < float("inf") and 0.0 <= std < float("inf"):
                    place = place_of(numbers, at)
                    figures.append(
                        Figure(
                            name=name, side=side, place=place, value=float(value), std=float(std), sensor=numbers.sensor
                        )
                    )
    return tuple(figures)


Mark = Literal["good", "warn", "bad", "missing"]
#: Standard deviations on each side of a value that have to lie in a band: 95 % of a normal distribution.
COVERAGE_FACTOR = 2.0


class Limit(Frozen):
    """The bands of one figure. `place`: of a figure of several numbers (`fx`), which; empty: all. None as an end: no
    limit there."""

    figure: str = Field(min_length=1, max_length=200)
    side: Side | None = None
    place: str = Field(default="", max_length=60)
    good: tuple[float | None, float | None]
    warn: tuple[float | None, float | None] | None = None

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.good == (None, None):
            raise ValueError("good: has no end; give one at least")
        for name, band in (("good", self.good), ("warn", self.warn or self.good)):
            low, high = _ends(band)
            if not low < high:
                raise ValueError(f"{name}: {low:g} isn't below {high:g}")
        (low, high), (outer_low, outer_high) = _ends(self.good), _ends(self.warn or self.good)
        if low < outer_low or high > outer_high:
            raise ValueError("warn: doesn't hold the whole good band")
        return self

    def concerns(self, figure: Figure) -> bool:
        """Return whether this limit is one of that figure."""
        return (
            fnmatchcase(figure.name, self.figure)
            and self.side in (None, figure.side)
            and self.place in ("", figure.place)
        )

    @property
    def good_text(self) -> str:
        """The good band, as a person reads it."""
        low, high = self.good
        return f"<= {high:g}" if low is None else f">= {low:g}" if high is None else f"{low:g} .. {high:g}"

    def judge(self, figure: Figure) -> Mark:
        """Return in which band the figure lies, the whole interval of two standard deviations on each side (ISO
        14253-1).

        >>> limit = Limit(figure="noise read_noise_e", good=(None, 3.0), warn=(None, 4.0))
        >>> limit.judge(Figure(name="noise read_noise_e", side="left", place="", value=2.9, std=0.1))
        'warn'
        """
        half = COVERAGE_FACTOR * figure.std
        for mark, band in (("good", self.good), ("warn", self.warn or self.good)):
            low, high = _ends(band)
            if low <= figure.value - half and figure.value + half <= high:
                return "good" if mark == "good" else "warn"
        return "bad"


def _ends(band: tuple[float | None, float | None]) -> tuple[float, float]:
    low, high = band
    return (-math.inf if low is None else low), (math.inf if high is None else high)


class CalibrationLimits(Frozen):
    """Limits of a laboratory. `valid_days`: how long a calibration that was certified against them may be used; None:
    until it is superseded. `drafted_from`: of a certificate's limits, the calibrations from which they, or some of
    them, were drafted; empty where a laboratory set them."""

    valid_days: float | None = Field(default=None, gt=0.0, le=36_500.0)
    limit: tuple[Limit, ...] = Field(min_length=1, max_length=500)
    drafted_from: tuple[str, ...] = Field(default=(), max_length=100)

    def dependence_on(self, id: str) -> str | None:
        """Return, in words, that these limits were drafted from the calibration that they judge; None: they weren't."""
        if id not in self.drafted_from:
            return None
        others = len(self.drafted_from) - 1
        whence = "this calibration alone" if not others else f"this calibration and {others} earlier"
        return (
            f"The limits were drafted from {whence}: that its figures lie within them is not an independent check. "
            "Certify against limits of your own, or against those drafted from three earlier calibrations."
        )


class Judgement(Frozen):
    """One figure against one limit. `value` None: the calibration doesn't have it. `title`, `unit`: as a lab reads
    them."""

    figure: str
    title: str = ""
    unit: str = "1"
    side: Side | None
    place: str
    value: float | None
    std: float | None
    limit: Limit
    mark: Mark


def judge_figures(figures: tuple[Figure, ...], limits: CalibrationLimits) -> tuple[Judgement, ...]:
    """Judge every figure that a limit concerns, in the order of the limits.

    figures : of a calibration, as `figures_of` lists them
    limits : of the laboratory

    Returns a judgement for each pair of limit and figure. A limit that concerns no figure has one of its own,
    `missing`.

    >>> limits = CalibrationLimits(limit=(Limit(figure="noise read_noise_e", good=(None, 3.0)),))
    >>> figure = Figure(name="noise read_noise_e", side="left", place="", value=2.0, std=0.1)
    >>> [judgement.mark for judgement in judge_figures((figure,), limits)]
    ['good']
    """
    judgements: list[Judgement] = []
    for limit in limits.limit:
        concerned = [figure for figure in figures if limit.concerns(figure)]
        judgements += [
            Judgement(
                figure=figure.name,
                title=figure.title,
                unit=figure.unit,
                side=figure.side,
                place=figure.place,
                value=figure.value,
                std=figure.std,
                limit=limit,
                mark=limit.judge(figure),
            )
            for figure in concerned
        ]
        if not concerned:
            judgements.append(
                Judgement(
                    figure=limit.figure,
                    title=plain_name(limit.figure, limit.place),
                    unit=unit_of(limit.figure),
                    side=limit.side,
                    place=limit.place,
                    value=None,
                    std=None,
                    limit=limit,
                    mark="missing",
                )
            )
    return tuple(judgements)


def standing_limits(folder: Path) -> CalibrationLimits | None:
    """Return the limits of a data folder, `limits.toml`; None where it has none. Raises InputError where they can't be
    used."""
    file = folder / "limits.toml"
    return read_limits(file) if file.exists() else None


def read_limits(file: Path) -> CalibrationLimits:
    r"""Return the limits of a TOML file. Raises InputError, one line for each problem.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "limits.toml"
    ...     _ = file.write_text('[[limit]]\nfigure = "noise read_noise_e"\ngood = [0.0, 3.0]\n')
    ...     read_limits(file).limit[0].good_text
    '0 .. 3'
    """
    table = read_toml(file, "give a file of limits")
    try:
        return CalibrationLimits.model_validate(table)
    except ValidationError as error:
        lines = [f"{file}: {'.'.join(map(str, problem['loc']))}: {problem['msg']}" for problem in error.errors()]
        raise InputError("\n".join(lines)) from error
