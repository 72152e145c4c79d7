"""Scenes: what stands in front of a camera, and how it is drawn without aliasing."""

from sim.scene.scenes import (
    Darkness,
    EdgeRegion,
    KnifeEdge,
    PlanarTarget,
    ReflectanceChart,
    Scene,
    ScreenPattern,
    SpectralImage,
    UniformField,
)
from sim.scene.warp import Warp

__all__ = [
    "Darkness",
    "EdgeRegion",
    "KnifeEdge",
    "PlanarTarget",
    "ReflectanceChart",
    "Scene",
    "ScreenPattern",
    "SpectralImage",
    "UniformField",
    "Warp",
]
