"""A camera's features that remember what they were set to before this project changed them, and can be set so again."""

from __future__ import annotations

from collections.abc import Collection

from drivers.camera.genicam_settings import SELECTORS, CameraFeatures, Features
from drivers.errors import Disconnected, InstrumentError, NoAnswer
from drivers.found_settings import FoundSettings
from drivers.instrument import Setting


class RememberedFeatures:
    """The features of a camera; `found` keeps what each was set to, by `Name` or, where a selector chooses,
    `Name[Entry]`."""

    def __init__(self, features: CameraFeatures, kept: FoundSettings) -> None:
        self._features, self._found = features, kept

    def has(self, name: str) -> bool:
        return self._features.has(name)

    def get(self, name: str) -> Setting:
        return self._features.get(name)

    def set(self, name: str, value: Setting) -> None:
        place = self._place(name)
        if place not in self._found:
            before = _readable(self._features, name)
            if before is not None and before != value:
                self._found.note(place, before)
        self._features.set(name, value)

    def note(self, name: str, value: Setting) -> None:
        """Keep what a feature was, where it was changed by other means."""
        self._found.note(name, value)

    def entries(self, name: str) -> Collection[str]:
        return self._features.entries(name)

    def limits(self, name: str) -> tuple[float, float]:
        return self._features.limits(name)

    def execute(self, name: str) -> None:
        self._features.execute(name)

    @property
    def found(self) -> dict[str, Setting]:
        """What was changed, by its place, as it was found."""
        return self._found.values

    def restore(self) -> None:
        """Set all as it was found, what was changed last first. What the camera refuses is tried once more when the
        rest is set, and stays kept if it is refused then, too. Raises `NoAnswer` and `Disconnected`; what isn't
        restored stays kept."""
        for _ in range(2):
            for place, value in self._found.last_first():
                if _was_set(self._features, place, value):
                    self._found.forget(place)

    def _place(self, name: str) -> str:
        selector = SELECTORS.get(name, "")
        return f"{name}[{self._features.get(selector)}]" if selector and self._features.has(selector) else name


def _readable(features: Features, name: str) -> Setting | None:
    try:
        return features.get(name)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        return None  # it can be written alone


def _was_set(features: Features, place: str, value: Setting) -> bool:
    name, _, entry = place.removesuffix("]").partition("[")
    try:
        if entry:
            features.set(SELECTORS[name], entry)
        features.set(name, value)
    except (NoAnswer, Disconnected):
        raise
    except InstrumentError:
        return _readable(features, name) == value
    return True
