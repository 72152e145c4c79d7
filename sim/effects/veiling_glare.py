"""Veiling glare: a share of the light is spread over the whole frame."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from sim.camera import CameraModel
from sim.effects.base import Effect
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import Image, Veil


class VeilingGlare(Effect):
    """I' = (1 - g) I + g (1 - h) <I> + g h N * I: OTF 1 at zero frequency, 1 - g at every other that a frame holds but
    for the lowest, where a share h of the veil lies about its source, by a normal distribution N.
    """

    name: ClassVar[str] = "veiling_glare"
    family: ClassVar[Family] = Family.COPIES_AND_VEILS
    reference: ClassVar[str] = "ISO 9358:1994; ISO 18844:2017"
    form_tolerance: ClassVar[float] = 0.1
    invariances: ClassVar[frozenset[str]] = frozenset({"exposure", "wavelength", "level", "orientation", "time"})
    shapes: ClassVar[frozenset[str]] = frozenset({"halo_share", "halo_reach"})
    sentence: ClassVar[str] = (
        "Light scattered in the lens veils the frame: dark patches and dark squares are raised by a share of the light "
        "around them, while uniform fields stay as they are."
    )

    share_percent: Annotated[
        float,
        Quantity(
            "%", "share of the light that is spread over the frame", lower=0.0, upper=50.0, prior=(0.0, 2.0), absent=0.0
        ),
    ] = 0.0
    halo_share: Annotated[
        float,
        Quantity("1", "of that light: what stays about its source", lower=0.0, upper=1.0, prior=(0.0, 0.5), absent=0.0,
                 dispensable=True),
    ] = 0.0  # fmt: skip
    halo_reach: Annotated[
        float,
        Quantity("1", "standard deviation of what stays, in half diagonals", lower=0.2, upper=1.0, prior=(0.35, 0.15),
                 absent=0.35, dispensable=True),
    ] = 0.35  # fmt: skip

    @classmethod
    def prototypes(cls, camera: CameraModel) -> tuple[tuple[Self, ...], ...]:
        return ((cls(share_percent=0.6),), (cls(share_percent=0.6, halo_share=0.7),))

    def on_image(self, image: Image) -> Image:
        share = self.share_percent / 100.0
        if share == 0.0:
            return image
        return image.add_laws(
            veils=Veil(
                share * (1.0 - self.halo_share),
                share * self.halo_share,
                self.halo_reach * image.camera.half_diagonal_um,
            )
        )
