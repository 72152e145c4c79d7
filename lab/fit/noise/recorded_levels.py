"""The levels of one camera that the noise fit works on: flats, and the darks of one temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from lab.fit.noise.level_statistics import MeasuredLevel
from lab.formats.recording_set import DataSheet

BLACK_CLIPPED_SHARE = 1e-3  # of pixels at 0 in a dark, above which darks are clipped


@dataclass(frozen=True)
class Remarks:
    """What a fit has to say beside its figures, each sentence once."""

    sentences: list[str] = field(default_factory=list)

    def add(self, sentence: str) -> None:
        """Add a sentence where it isn't there yet."""
        if sentence not in self.sentences:
            self.sentences.append(sentence)


@dataclass(frozen=True)
class RecordedLevels:
    """Levels of one camera at one gain.

    `names`: planes of the mosaic. `flats`: in ascending light. `all_darks`: in ascending exposure; `darks`: those of
    `temperature_c`, none where they are clipped at 0 (`black_clipped`). `defects`: pixels that were left out of all
    levels.
    """

    camera: DataSheet
    gain_db: float
    defects: int
    names: tuple[str, ...]
    flats: tuple[MeasuredLevel, ...]
    all_darks: tuple[MeasuredLevel, ...]
    darks: tuple[MeasuredLevel, ...]
    temperature_c: float | None
    black_clipped: bool

    @property
    def white_dn(self) -> float:
        """Highest code."""
        return self.camera.saturation_dn

    @classmethod
    def of(
        cls,
        darks: Sequence[MeasuredLevel],
        flats: Sequence[MeasuredLevel],
        camera: DataSheet,
        gain_db: float,
        defects: int,
        names: tuple[str, ...],
        remarks: Remarks,
    ) -> RecordedLevels:
        """Choose the darks of the temperature at which most flats (or else most darks) were taken."""
        bright = tuple(sorted(flats, key=lambda level: (level.light, level.exposure_s)))
        every = tuple(sorted(darks, key=lambda level: level.exposure_s))
        present = [level.temperature_c for level in every]
        wanted = [rounded_c(level.temperature_c) for level in bright]
        temperature = max(dict.fromkeys(present), key=lambda t: (wanted.count(t), present.count(t)), default=None)
        own = tuple(level for level in every if level.temperature_c == temperature)
        clipped = any(level.plane[name].zero_share > BLACK_CLIPPED_SHARE for level in own for name in names)
        if clipped:
            remarks.add(
                "dark frames are clipped at 0 DN: black level, read noise, dark current and DSNU aren't determined; raise the black level"
            )
        return cls(camera, gain_db, defects, names, bright, every, () if clipped else own, temperature, clipped)


def rounded_c(temperature_c: float | None) -> float | None:
    """A temperature to a degree; levels of one degree belong together."""
    return None if temperature_c is None else float(round(temperature_c))
