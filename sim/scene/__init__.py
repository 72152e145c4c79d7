"""Scenes in front of a camera, drawn without aliasing."""

from sim.scene.scenes import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    PlaneEdge,
    PointArray,
    PosedEdges,
    Ramp,
    ReflectanceChart,
    Scene,
    ScreenImage,
    ScreenPattern,
    SiemensStar,
    SpectralImage,
    UniformField,
    ZonePlate,
)
from sim.scene.screen import Screen, SubPixels
from sim.scene.warp import Warp

__all__ = [
    "Darkness",
    "EdgeRegion",
    "KnifeEdge",
    "PlanarTarget",
    "PlaneEdge",
    "PointArray",
    "PosedEdges",
    "Ramp",
    "ReflectanceChart",
    "Scene",
    "Screen",
    "ScreenImage",
    "ScreenPattern",
    "SiemensStar",
    "SpectralImage",
    "SubPixels",
    "UniformField",
    "Warp",
    "ZonePlate",
]
