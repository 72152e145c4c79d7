"""The public Python interface of calibench: what may be relied on from outside. Everything else is private. ::

    import calibench

    recordings = calibench.open_recordings("my-camera")   # a recording set, or a folder of raw files
    fit = calibench.fit(recordings)                       # shows its figures and a chart in a notebook
    diagnosis = calibench.diagnose(recordings, fit)
    calibench.plot(diagnosis)
    fit.to_dataframe()

Functions of one call are those of `lab.interface`; results are the types of `lab.formats.results`, frozen, with units
in their names. Nothing heavy is imported before it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lab.errors import DeviceError, InputError, NotDetermined
from lab.interface import (
    bench_devices,
    certify,
    compare,
    diagnose,
    evaluate,
    fit,
    fitted_cameras,
    mock_bench,
    open_recordings,
    open_seal,
    predict,
    read_camera,
    read_result,
    score,
    seal,
    simulate,
    validate,
    write_camera,
    write_certificate,
    write_frame,
    write_report,
    write_result,
)

if TYPE_CHECKING:
    from api.client import ServiceClient, ServiceProblem, ServiceUnreachable, connect
    from api.local_service import local_service
    from lab.calibration.limits import CalibrationLimits, Limit
    from lab.fit.mtf import edge_mtf
    from lab.fit.psf import estimate_kernel
    from lab.fit.spectral import estimate_sensitivity
    from lab.formats.camera_file import CameraFile, default_camera
    from lab.formats.results import (
        CameraFit,
        ComparisonResult,
        DiagnosisResult,
        FitResult,
        MtfCurve,
        NamedEffect,
        NoiseFit,
        SpectralFit,
        ValidationResult,
    )
    from lab.pipeline import PipelineResult
    from lab.recording import RecordingSet, read, write
    from lab.report.plots import Chart, charts_of, plot
    from lab.twin.score import TwinScore
    from lab.twin.sealed import SealedPrediction

#: Names that are imported when they are asked for, by their module.
_LATER = {
    "api.client": ("ServiceClient", "ServiceProblem", "ServiceUnreachable", "connect"),
    "api.local_service": ("local_service",),
    "lab.calibration.limits": ("CalibrationLimits", "Limit"),
    "lab.fit.mtf": ("edge_mtf",),
    "lab.fit.psf": ("estimate_kernel",),
    "lab.fit.spectral": ("estimate_sensitivity",),
    "lab.formats.camera_file": ("CameraFile", "default_camera"),
    "lab.formats.results": (
        "CameraFit",
        "ComparisonResult",
        "DiagnosisResult",
        "FitResult",
        "MtfCurve",
        "NamedEffect",
        "NoiseFit",
        "SpectralFit",
        "ValidationResult",
    ),
    "lab.pipeline": ("PipelineResult",),
    "lab.recording": ("RecordingSet", "read", "write"),
    "lab.report.plots": ("Chart", "charts_of", "plot"),
    "lab.twin.score": ("TwinScore",),
    "lab.twin.sealed": ("SealedPrediction",),
}

__all__ = [
    "CalibrationLimits",
    "CameraFile",
    "CameraFit",
    "Chart",
    "ComparisonResult",
    "DeviceError",
    "DiagnosisResult",
    "FitResult",
    "InputError",
    "Limit",
    "MtfCurve",
    "NamedEffect",
    "NoiseFit",
    "NotDetermined",
    "PipelineResult",
    "RecordingSet",
    "SealedPrediction",
    "ServiceClient",
    "ServiceProblem",
    "ServiceUnreachable",
    "SpectralFit",
    "TwinScore",
    "ValidationResult",
    "bench_devices",
    "certify",
    "charts_of",
    "compare",
    "connect",
    "default_camera",
    "diagnose",
    "edge_mtf",
    "estimate_kernel",
    "estimate_sensitivity",
    "evaluate",
    "fit",
    "fitted_cameras",
    "local_service",
    "mock_bench",
    "open_recordings",
    "open_seal",
    "plot",
    "predict",
    "read",
    "read_camera",
    "read_result",
    "score",
    "seal",
    "simulate",
    "validate",
    "write",
    "write_camera",
    "write_certificate",
    "write_frame",
    "write_report",
    "write_result",
]


def __getattr__(name: str) -> Any:
    for module, names in _LATER.items():
        if name in names:
            found = getattr(importlib.import_module(module), name)
            globals()[name] = found
            return found
    raise AttributeError(f"module 'calibench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
