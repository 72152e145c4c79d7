"""A kind of capture that calibench doesn't have, written after `docs/how-to/add-a-capture-kind.md`: a transmissive step
wedge."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from lab.capture_kinds.base import (
    Capture,
    Equipment,
    Reading,
    RelativeExposure,
    Sequence,
    Setting,
    SpectrumPath,
    Step,
    Target,
    exposure_step,
    planned_keys,
    spectrum_path,
)
from sim.parameters import Frozen
from sim.scene.scenes import Scene, UniformField
from sim.spectrum import Spectrum

Region = tuple[int, int, int, int]


class WedgeLayout(Frozen):
    """Where the steps lie in one camera's frame, nominally."""

    regions: tuple[Region, ...]


class WedgeTarget(Target):
    """A step wedge before the sphere."""

    kind: Literal["step_wedge"]
    density: tuple[float, ...]
    left: WedgeLayout
    right: WedgeLayout

    @property
    def instruction(self) -> str:
        return f"put the wedge of {len(self.density)} steps before the sphere"


class WedgeSequence(Sequence):
    """`frames` of the wedge in white light."""

    name: ClassVar[str] = "wedge"
    purpose: ClassVar[str] = "linearity over densities"
    instruments: ClassVar[tuple[str, ...]] = ("monochromator", "spectroradiometer")
    targets: ClassVar[tuple[type[Target], ...]] = (WedgeTarget,)

    frames: int = Field(default=4, ge=1)

    @classmethod
    def planned(cls, station: Equipment, quick: bool) -> Self | None:
        return cls(frames=2 if quick else 4) if cls.possible(station) else None

    def steps(self, station: Equipment) -> tuple[Step, ...]:
        self.check_instruments(station)
        name = station.one(WedgeTarget)
        wedge = station.list_targets(WedgeTarget)[name]
        lit = Setting(target=name, wavelength_nm=0.0)
        found = exposure_step("wedge", "step wedge", lit, 0.7)
        taken = [
            Step(
                id=f"wedge/{frame}",
                what=f"step wedge, frame {frame} of {self.frames}",
                setting=lit,
                exposure=RelativeExposure(of=found.id),
                captures=tuple(
                    WedgeCapture(
                        kind="step_wedge",
                        density=wedge.density,
                        regions=getattr(wedge, side).regions,
                        radiance=spectrum_path(found.id),
                        **planned_keys(f"wedge/{frame}", side),
                    )
                    for side in station.sides
                ),
            )
            for frame in range(1, self.frames + 1)
        ]
        return (found, *taken)


class WedgeCapture(Capture):
    """A step wedge: `density` of each step, `regions` of the steps in the frame, `radiance` of the open sphere."""

    shows: ClassVar[str] = "a step wedge before the sphere"
    sequence: ClassVar[type[Sequence] | None] = WedgeSequence

    kind: Literal["step_wedge"]
    density: tuple[float, ...]
    regions: tuple[Region, ...]
    radiance: SpectrumPath
    bandwidth_nm: Annotated[float | None, Reading("bandwidth_nm")] = None

    def problems(self, rows: int, cols: int) -> Iterator[str]:
        if len(self.density) != len(self.regions):
            yield f"{len(self.density)} densities and {len(self.regions)} regions; give one density a region"

    def remarks(self) -> Iterator[str]:
        if len(self.density) < 3:
            yield f"{len(self.density)} steps tell no curve; use a wedge of 3 steps at least"

    def scene(self, spectrum: Callable[[str], Spectrum]) -> Scene | None:
        return UniformField(spectrum(self.radiance), self.kind)


KIND = WedgeCapture
