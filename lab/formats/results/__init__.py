"""What the commands write with `--json`: frozen, every number with its unit in its name, every fitted `x` with `x_std`.

`None` where the recordings don't determine a number. The reason stands in `skipped` then.
"""

from lab.formats.results.blur import MtfCurve, PsfKernel, PsfSymmetry
from lab.formats.results.comparison import Change, ComparisonResult, ProjectionChange
from lab.formats.results.diagnosis import (
    DiagnosisResult,
    ExaminedPlace,
    HeldOut,
    MeasurementFit,
    Mismatch,
    NamedEffect,
    NextCapture,
    ParameterValue,
    PolicyRule,
    ResidualCurve,
    ResidualPicture,
    Resolution,
    Rival,
    Unexplained,
    Visibility,
)
from lab.formats.results.fit import CameraFit, FitResult
from lab.formats.results.geometry import (
    BoardWarp,
    ChannelGeometry,
    CrossValidation,
    DepthUncertainty,
    DistortionModel,
    GeometryFit,
    ProjectionUncertainty,
    Rectification,
    StereoFit,
    ViewResiduals,
)
from lab.formats.results.noise import (
    ChannelNoise,
    DarkCurrentLaws,
    Defect,
    Emva1288,
    Emva1288Points,
    NoiseFit,
    PhotonTransfer,
    PixelDefects,
    ReadNoiseDistribution,
)
from lab.formats.results.skipped import Skipped
from lab.formats.results.spectral import MakerDeparture, SpectralFit
from lab.formats.results.validation import Check, CurveComparison, KernelPair, PatchComparison, ValidationResult

__all__ = [
    "BoardWarp",
    "CameraFit",
    "Change",
    "ChannelGeometry",
    "ChannelNoise",
    "Check",
    "ComparisonResult",
    "CrossValidation",
    "CurveComparison",
    "DarkCurrentLaws",
    "Defect",
    "DepthUncertainty",
    "DiagnosisResult",
    "DistortionModel",
    "Emva1288",
    "Emva1288Points",
    "ExaminedPlace",
    "FitResult",
    "GeometryFit",
    "HeldOut",
    "KernelPair",
    "MakerDeparture",
    "MeasurementFit",
    "Mismatch",
    "MtfCurve",
    "NamedEffect",
    "NextCapture",
    "NoiseFit",
    "ParameterValue",
    "PatchComparison",
    "PhotonTransfer",
    "PixelDefects",
    "PolicyRule",
    "ProjectionChange",
    "ProjectionUncertainty",
    "PsfKernel",
    "PsfSymmetry",
    "ReadNoiseDistribution",
    "Rectification",
    "ResidualCurve",
    "ResidualPicture",
    "Resolution",
    "Rival",
    "Skipped",
    "SpectralFit",
    "StereoFit",
    "Unexplained",
    "ValidationResult",
    "ViewResiduals",
    "Visibility",
]
