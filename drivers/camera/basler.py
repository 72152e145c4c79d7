"""Basler cameras (USB3, GigE, CXP) through pypylon, the maker's library: `calibench[basler]`.

With PYLON_CAMEMU=2 in the environment the library itself emulates two cameras.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator
from typing import Any, TypeVar

from drivers.camera.buffers import Grabbed
from drivers.camera.genicam import GenicamCamera
from drivers.errors import Disconnected, InstrumentError, InUse
from drivers.instrument import Identity, Setting

_T = TypeVar("_T")
_READY_S = 1.0


def pylon_library() -> Any:
    """Return the module `pypylon.pylon`. Raises `InstrumentError` where it isn't installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # of its wrapper generator; as an error it ends the process
            from pypylon import pylon
    except ImportError as error:
        raise InstrumentError(
            "Basler cameras: pypylon isn't installed; install calibench with its extra basler"
        ) from error
    return pylon


def _message_of(error: Exception) -> str:
    """Return what the library says, without the place in its sources."""
    return " ".join(str(error).split(" : ")[0].split())


class _PylonNodes:
    """A camera's features through pypylon."""

    def __init__(self, nodes: Any, who: str) -> None:
        from pypylon import genicam

        self._nodes, self._who, self._genicam = nodes, who, genicam

    def _do(self, name: str, action: Callable[[Any], _T]) -> _T:
        try:
            return action(self._nodes.GetNode(name))
        except self._genicam.GenericException as error:
            raise InstrumentError(
                f"{self._who}: feature {name}: {_message_of(error)}; check that the camera is there and has it"
            ) from error

    def has(self, name: str) -> bool:
        return bool(self._do(name, lambda node: node is not None and self._genicam.IsAvailable(node)))

    def get(self, name: str) -> Setting:
        return self._do(name, lambda node: node.GetValue())

    def set(self, name: str, value: Setting) -> None:
        self._do(name, lambda node: node.SetValue(value))

    def entries(self, name: str) -> Collection[str]:
        return self._do(name, lambda node: tuple(node.Symbolics))

    def limits(self, name: str) -> tuple[float, float]:
        return self._do(name, lambda node: (float(node.GetMin()), float(node.GetMax())))

    def execute(self, name: str) -> None:
        self._do(name, lambda node: node.Execute())


class BaslerCamera(GenicamCamera):
    """The Basler camera with the serial number `address`."""

    _camera: Any = None
    _tick_ns = 1.0  # of the camera's clock

    @staticmethod
    def enumerate_cameras() -> Iterator[tuple[str, str]]:
        """Yield (address, what it is) of every camera that pypylon finds."""
        for info in pylon_library().TlFactory.GetInstance().EnumerateDevices():
            yield info.GetSerialNumber(), f"Basler {info.GetModelName()} {info.GetSerialNumber()}"

    def _open(self) -> tuple[_PylonNodes, Identity]:
        pylon = pylon_library()
        from pypylon import genicam

        try:
            factory = pylon.TlFactory.GetInstance()
            infos = {info.GetSerialNumber(): info for info in factory.EnumerateDevices()}
            if self.address not in infos:
                there = ", ".join(infos) or "none"
                raise Disconnected(
                    f"camera {self.address}: pypylon finds no such camera; there are: {there}; is it plugged in?"
                )
            info = infos[self.address]
            self._camera = pylon.InstantCamera(factory.CreateDevice(info))
            self._camera.Open()
        except genicam.GenericException as error:
            message = _message_of(error)
            kind = (
                InUse
                if "controlled by another application" in message or "exclusively opened" in message
                else Disconnected
            )
            raise kind(
                f"camera {self.address}: can't be opened ({message}); close other programs that use it"
            ) from error
        firmware = info.GetDeviceVersion() if info.IsDeviceVersionAvailable() else ""
        identity = Identity(info.GetVendorName(), info.GetModelName(), info.GetSerialNumber(), firmware)
        nodes = _PylonNodes(self._camera.GetNodeMap(), f"camera {self.address}")
        if nodes.has("GevTimestampTickFrequency"):
            self._tick_ns = 1e9 / float(nodes.get("GevTimestampTickFrequency"))
        return nodes, identity

    def _start(self) -> None:
        self._library(lambda: self._camera.StartGrabbing(pylon_library().GrabStrategy_OneByOne))

    def _halt(self) -> None:
        self._library(self._camera.StopGrabbing)

    def _await_trigger_ready(self) -> None:
        """Where the camera tells when it is ready, that is waited for."""
        pylon = pylon_library()

        def wait() -> None:
            if self._camera.CanWaitForFrameTriggerReady():
                self._camera.WaitForFrameTriggerReady(round(1000 * _READY_S), pylon.TimeoutHandling_ThrowException)

        self._library(wait)

    def _grab(self, timeout_s: float) -> Grabbed | None:
        pylon = pylon_library()
        result = self._library(
            lambda: self._camera.RetrieveResult(max(1, round(1000 * timeout_s)), pylon.TimeoutHandling_Return)
        )
        if result is None or not result.IsValid():
            return None
        try:
            return Grabbed(
                payload=result.GetBuffer(),  # a copy
                rows=int(result.GetHeight()),
                cols=int(result.GetWidth()),
                code=int(result.GetPixelType()) & 0xFFFFFFFF,
                frame_id=int(result.GetBlockID()),
                padding=int(result.GetPaddingX()),
                damage=""
                if result.GrabSucceeded()
                else " ".join(str(result.GetErrorDescription()).split()) or "no reason told",
                camera_time_ns=round(int(result.GetTimeStamp()) * self._tick_ns) or None,
            )
        finally:
            result.Release()

    def _library(self, action: Callable[[], _T]) -> _T:
        from pypylon import genicam

        try:
            return action()
        except genicam.GenericException as error:
            raise Disconnected(
                f"{self._who}: {_message_of(error)}; plug it in again, the next call reconnects"
            ) from error

    def _release(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.Close()
