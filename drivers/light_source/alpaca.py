"""ASCOM Alpaca's flat-field panels (CoverCalibrator), by HTTP."""

from __future__ import annotations

from drivers.alpaca import AlpacaDevice
from drivers.errors import InstrumentError
from drivers.instrument import Identity, Recorder
from drivers.light_source.base import SteppedLamp

#: CalibratorStatus.
_NOT_PRESENT, _OFF, _CHANGING, _UNKNOWN, _FAILED = 0, 1, 2, 4, 5


class AlpacaLamp(SteppedLamp):
    """The lamp `host:port/NUMBER` of an Alpaca server."""

    def __init__(
        self, address: str, *, timeout_s: float = 5.0, settle_s: float = 60.0, recorder: Recorder | None = None
    ) -> None:
        super().__init__(address, timeout_s=timeout_s, settle_s=settle_s, recorder=recorder)
        self._device = AlpacaDevice(address, "covercalibrator", self._left_s, self._record)

    def _open(self) -> tuple[Identity, float]:
        identity = self._device.identity()
        if not self._device.get("connected"):
            self._device.put("connected", Connected=True)
        if self._state() == _NOT_PRESENT:
            raise InstrumentError(f"{self._who}: this device has a cover, and no lamp; correct its number")
        return identity, float(self._device.get("maxbrightness"))

    def _state(self) -> int:
        state = int(self._device.get("calibratorstate"))
        if state == _FAILED:
            raise InstrumentError(f"{self._who}: the lamp says that it failed; look into its server's log")
        return state

    def _read(self) -> float:
        return 0.0 if self._state() == _OFF else float(self._device.get("brightness"))

    def _light(self, step: float) -> None:
        self._device.put("calibratoron", Brightness=int(step))

    def _darken(self) -> None:
        self._device.put("calibratoroff")

    def _is_steady(self) -> bool:
        return self._state() not in (_CHANGING, _UNKNOWN)

    def _release(self) -> None:
        """Each request had a connection of its own."""
