"""What all standards have in common: a figure is a property whose docstring declares it, a requirement a line.

A file a standard. Its class holds the input of one subject (a plane, an edge, a camera), its figures are properties
that return an `Estimate` or raise `NotDetermined`, and its requirements yield what the recordings don't meet. The
declaration of a figure stands in its docstring once, and page, table and documentation read it there:

    @ClauseFigure
    def system_gain(self) -> Estimate:
        '''Return the system gain.

        Clause: 6.6. Symbol: K. Unit: DN/e.
        Formula: slope of ...
        '''
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from lab.errors import NotDetermined
from lab.formats.camera_model import camera_model
from lab.formats.recording_set import DataSheet, RecordingSet
from lab.formats.results import CameraFit
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, StandardFigure, StandardMap, StandardPlot, StandardReading
from lab.observables.dataset import Dataset
from sim.camera import Side

_DECLARED = re.compile(
    r"Return (?:the )?(?P<quantity>.+?)\.\n.*?"
    r"Clause: (?P<clause>.+?)\. Symbol: (?P<symbol>.+?)\. Unit: (?P<unit>\S+?)\.\s+Formula: (?P<formula>.+?)\.\s*\Z",
    re.DOTALL,
)


@dataclass(frozen=True)
class Declaration:
    """What a figure's docstring declares."""

    name: str
    quantity: str
    clause: str
    symbol: str
    unit: str
    formula: str


class ClauseFigure(property):
    """A property that is a figure of a standard. Raises ValueError for a docstring that doesn't declare it."""

    def __init__(self, compute: Callable[[Any], Estimate]) -> None:
        declared = _DECLARED.search(compute.__doc__ or "")
        if declared is None:
            raise ValueError(
                f"{compute.__qualname__}: its docstring declares no figure; write 'Return the QUANTITY.', 'Clause: ... "
                "Symbol: ... Unit: ....' and 'Formula: ....'"
            )
        super().__init__(compute)
        words = {key: " ".join(text.split()) for key, text in declared.groupdict().items()}
        self.declaration = Declaration(name=compute.__name__, **words)


class MeasuredSide:
    """One side of a recording set with its fit, from which standards are read. What they share is computed once."""

    def __init__(self, recordings: RecordingSet, side: Side, fit: CameraFit) -> None:
        self.recordings, self.side, self.fit = recordings, side, fit

    @property
    def camera(self) -> DataSheet:
        """The camera's data sheet."""
        return self.recordings.camera(self.side)

    @cached_property
    def dataset(self) -> Dataset:
        """The side's frames, summarised once."""
        model = camera_model(self.recordings, self.side, self.fit)
        return Dataset(self.recordings, self.side, model, fitted=self.fit.noise)

    @property
    def instruments(self) -> tuple[str, ...]:
        """The instruments that took the recordings, one line each."""
        return tuple(
            " ".join(
                part for part in (f"{name}:", instrument.maker, instrument.model, instrument.serial_number) if part
            )
            for name, instrument in self.recordings.manifest.instruments.items()
        )


@dataclass(frozen=True)
class NotDone:
    """A figure of a standard that isn't computed, and why, or with which target it would be."""

    clause: str
    figure: str
    why: str


class Standard:
    """A standard, read on one subject.

    `name`: number and year; `title`: what it measures; `target`: what has to be captured; `compared`: the peer and its
    version, and by how much the two differ; `not_done`: figures that the standard has and this class hasn't. Subclasses
    add figures, and override what they have."""

    name: ClassVar[str]
    title: ClassVar[str]
    target: ClassVar[str]
    compared: ClassVar[str] = "no peer on the package index; closed forms in the tests"
    not_done: ClassVar[tuple[NotDone, ...]] = ()

    def __init__(self, measured: MeasuredSide, subject: str) -> None:
        self.measured, self.subject = measured, subject

    @classmethod
    def declarations(cls) -> dict[str, Declaration]:
        """Return what the figures declare, in the order of their definition, a base's first."""
        return {
            name: member.declaration
            for base in reversed(cls.__mro__)
            for name, member in vars(base).items()
            if isinstance(member, ClauseFigure)
        }

    def deviations(self) -> Iterator[Deviation]:
        """Yield the requirements that the recordings don't meet."""
        yield from ()

    def conditions(self) -> Iterator[str]:
        """Yield what was measured and how."""
        yield from ()

    def remarks(self) -> Iterator[str]:
        """Yield where the reading differs from the standard, and biases of the standard's own estimator."""
        yield from ()

    def plots(self) -> Iterator[StandardPlot]:
        """Yield the plots."""
        yield from ()

    def maps(self) -> Iterator[StandardMap]:
        """Yield the maps over the frame."""
        yield from ()

    def read(self) -> StandardReading:
        """Return all that the standard says of the subject. Raises NotDetermined where no figure is determined."""
        deviations = tuple(self.deviations())
        everywhere = any(not deviation.figures for deviation in deviations)
        touched = {name for deviation in deviations for name in deviation.figures}
        figures = []
        for name, declared in self.declarations().items():
            estimate, reason = None, ""
            try:
                estimate = getattr(self, name)
            except NotDetermined as refused:
                reason = refused.reason
            figures.append(
                StandardFigure(
                    **vars(declared),
                    estimate=estimate,
                    reason=reason,
                    by_the_standard=estimate is not None and not everywhere and name not in touched,
                )
            )
        if all(figure.estimate is None for figure in figures):
            raise NotDetermined(self.name, figures[0].reason)
        return StandardReading(
            standard=self.name,
            title=self.title,
            side=self.measured.side,
            subject=self.subject,
            figures=tuple(figures),
            deviations=deviations,
            conditions=(*self.conditions(), *self.measured.instruments),
            remarks=tuple(self.remarks()),
            plots=tuple(self.plots()),
            maps=tuple(self.maps()),
        )
