"""INDI's flat-field panels (light boxes), by XML over TCP."""

from __future__ import annotations

from drivers.indi import IndiDevice
from drivers.instrument import Identity, Recorder
from drivers.light_source.base import SteppedLamp

_SWITCH, _INTENSITY, _VALUE = "FLAT_LIGHT_CONTROL", "FLAT_LIGHT_INTENSITY", "FLAT_LIGHT_INTENSITY_VALUE"


class IndiLamp(SteppedLamp):
    """The lamp `host:port/NAME` of an INDI server."""

    def __init__(
        self, address: str, *, timeout_s: float = 5.0, settle_s: float = 60.0, recorder: Recorder | None = None
    ) -> None:
        super().__init__(address, timeout_s=timeout_s, settle_s=settle_s, recorder=recorder)
        self._device = IndiDevice(address, self._left_s, self._record)

    def _open(self) -> tuple[Identity, float]:
        self._device.open()
        self._device.connect(_SWITCH, _INTENSITY)
        return self._device.identity(), self._device.limits(f"{_INTENSITY}.{_VALUE}")[1]

    def _read(self) -> float:
        for name in (_SWITCH, _INTENSITY):
            self._device.ask(name)
        lit = self._device.get(_SWITCH) == "FLAT_LIGHT_ON"
        return self._device.number(_INTENSITY, _VALUE) if lit else 0.0

    def _light(self, step: float) -> None:
        self._device.set(_INTENSITY, f"{_VALUE}={step:g}")
        self._device.set(_SWITCH, "FLAT_LIGHT_ON")

    def _darken(self) -> None:
        self._device.set(_SWITCH, "FLAT_LIGHT_OFF")

    def _is_steady(self) -> bool:
        return "Busy" not in (self._device.state(_SWITCH), self._device.state(_INTENSITY))

    def _release(self) -> None:
        self._device.close()
