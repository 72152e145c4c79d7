"""ISO 17957:2015: luminance and colour shading over 11 x 11 blocks of an even light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.errors import NotDetermined
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, StandardMap
from lab.standards.standard import ClauseFigure, MeasuredSide, NotDone, Standard
from sim.sensor import mosaic
from sim.spectrum import FloatArray

BLOCKS = 11
#: Of saturation, of the central block: about what an sRGB value of 110 to 130 is in a linear signal.
LOWEST_LEVEL, HIGHEST_LEVEL = 0.15, 0.23
#: Level that is read: the brightest below this share of saturation.
BRIGHTEST = 0.85


@dataclass(frozen=True)
class Blocks:
    """Means above the dark of 11 x 11 blocks by channel, DN (blocks, blocks), their standard deviations, number of
    frames, and the central block's share of saturation in the brightest channel."""

    mean: dict[str, FloatArray]
    std: dict[str, FloatArray]
    frames: int
    level: float

    @property
    def luminance_channel(self) -> str:
        """Green, or the only channel."""
        return "G" if "G" in self.mean else next(iter(self.mean))

    @property
    def luminance(self) -> tuple[FloatArray, FloatArray]:
        """Its blocks over the central one, and standard deviations."""
        return self.ratio(self.luminance_channel, None)

    def ratio(self, channel: str, other: str | None) -> tuple[FloatArray, FloatArray]:
        """Blocks of a channel, over those of another where one is given, over the central one; and their standard
        deviations. The central block's own is common to all, and part of them."""
        value, relative = self.mean[channel], self.std[channel] / self.mean[channel]
        if other is not None:
            value = value / self.mean[other]
            relative = np.hypot(relative, self.std[other] / self.mean[other])
        middle = BLOCKS // 2
        ratio = value / value[middle, middle]
        std = ratio * np.hypot(relative, relative[middle, middle])
        std[middle, middle] = 0.0
        return ratio, std


class Iso17957(Standard):
    """ISO 17957:2015, of one camera."""

    name: ClassVar[str] = "ISO 17957:2015"
    title: ClassVar[str] = "luminance and colour shading"
    target: ClassVar[str] = "flats of one level"
    compared: ClassVar[str] = "no peer on the package index; closed forms in the tests"
    not_done: ClassVar[tuple[NotDone, ...]] = (NotDone("6", "shading in CIELAB", "needs a finished image in sRGB"),)

    def __init__(self, side: MeasuredSide, blocks: Blocks) -> None:
        super().__init__(side, "whole frame")
        self.blocks = blocks

    def _extreme(self, channel: str, other: str | None, sign: float) -> Estimate:
        value, std = self.blocks.ratio(channel, other)
        at = np.unravel_index(int(np.argmax(sign * value)), value.shape)
        return Estimate(value=100.0 * float(value[at] - 1.0), std=100.0 * float(std[at]), unit="%")

    @ClauseFigure
    def luminance_shading(self) -> Estimate:
        """Return the luminance shading.

        Clause: 6. Symbol: S_L. Unit: %.
        Formula: 100 (L_block / L_centre − 1) of the darkest of 11 × 11 blocks.
        """
        value, std = self.blocks.luminance
        at = np.unravel_index(int(np.argmin(value)), value.shape)
        return Estimate(value=100.0 * float(value[at] - 1.0), std=100.0 * float(std[at]), unit="%")

    @ClauseFigure
    def corner_shading(self) -> Estimate:
        """Return the mean luminance shading of the corners.

        Clause: 6. Symbol: S_L.corner. Unit: %.
        Formula: 100 (mean of the four corner blocks / L_centre − 1).
        """
        channel = self.blocks.luminance_channel
        mean, std = self.blocks.mean[channel], self.blocks.std[channel]
        corners, middle = ([0, 0, -1, -1], [0, -1, 0, -1]), BLOCKS // 2
        ratio = float(mean[corners].mean() / mean[middle, middle])
        # the error of the central block is common to the four
        corners_std = float(np.sqrt(np.sum(std[corners] ** 2))) / float(mean[corners].sum())
        relative = float(np.hypot(corners_std, std[middle, middle] / mean[middle, middle]))
        return Estimate(value=100.0 * (ratio - 1.0), std=100.0 * ratio * relative, unit="%")

    def _colour(self, channel: str) -> Estimate:
        if channel not in self.blocks.mean:
            raise NotDetermined(self.name, "a monochrome camera has no colour shading")
        low, high = self._extreme(channel, "G", -1.0), self._extreme(channel, "G", 1.0)
        return low if abs(low.value) > abs(high.value) else high

    @ClauseFigure
    def red_shading(self) -> Estimate:
        """Return the colour shading of red over green.

        Clause: 6. Symbol: S_R/G. Unit: %.
        Formula: 100 ((R/G)_block / (R/G)_centre − 1) of largest modulus.
        """
        return self._colour("R")

    @ClauseFigure
    def blue_shading(self) -> Estimate:
        """Return the colour shading of blue over green.

        Clause: 6. Symbol: S_B/G. Unit: %.
        Formula: 100 ((B/G)_block / (B/G)_centre − 1) of largest modulus.
        """
        return self._colour("B")

    def deviations(self) -> Iterator[Deviation]:
        if not LOWEST_LEVEL <= self.blocks.level <= HIGHEST_LEVEL:
            yield Deviation(
                clause="5",
                quantity="level of the central block",
                found=f"{100.0 * self.blocks.level:.3g} % of saturation",
                limit="110 to 130 in sRGB, 15 to 23 % of saturation",
                remedy="nothing for a linear signal: ratios don't depend on the level",
            )
        yield Deviation(
            clause="5",
            quantity="light",
            found="of an integrating sphere or panel whose own uniformity isn't in the recordings",
            limit="a known uniformity",
            remedy="turn the camera by 180° before the light and compare: what stays in the frame is the camera's",
        )

    def conditions(self) -> Iterator[str]:
        yield f"{BLOCKS} × {BLOCKS} blocks, mean of {self.blocks.frames} raw frames above the dark"

    def maps(self) -> Iterator[StandardMap]:
        value, _ = self.blocks.luminance
        yield StandardMap(
            title="Luminance over that of the centre", unit="%", values=tuple(tuple(row) for row in 100.0 * value)
        )
        for channel in ("R", "B"):
            if channel in self.blocks.mean:
                value, _ = self.blocks.ratio(channel, "G")
                yield StandardMap(
                    title=f"{channel}/G over that of the centre",
                    unit="%",
                    values=tuple(tuple(row) for row in 100.0 * value),
                )


def measure_blocks(side: MeasuredSide) -> Blocks:
    """Return the blocks of the brightest level of flats below `BRIGHTEST` of saturation. Raises NotDetermined where
    there is none, and for frames smaller than the blocks."""
    data = side.dataset
    step = mosaic.step(data.camera.cfa)
    if min(side.camera.rows, side.camera.cols) < 2 * step * BLOCKS:
        raise NotDetermined(Iso17957.name, f"frames of {side.camera.rows} rows are too small for {BLOCKS} blocks")
    black = data.noise.black
    best: list[FlatCapture] = []
    level = 0.0
    for group in data.flat_levels():
        means = data.levels(group[0]).mean.values()
        if any(mean is None for mean in means):
            continue
        share = (max(mean or 0.0 for mean in means) - black) / (data.saturation_dn - black)
        if level < share < BRIGHTEST and (group[0].wavelength_nm is None or not best):
            best, level = group, share
    if not best:
        raise NotDetermined(Iso17957.name, "no unclipped flats; capture flats below saturation")
    offset = black + data.noise.dark_dn_per_s * best[0].exposure_s
    total = np.mean([np.asarray(data.recordings.frame(c), float) for c in best], axis=0) - offset
    mean: dict[str, FloatArray] = {}
    std: dict[str, FloatArray] = {}
    for channel in data.channels:
        planes = [total[r::step, c::step] for r, c in mosaic.phases(data.camera.cfa)[channel]]
        parts = [np.array_split(plane, BLOCKS, axis=0) for plane in planes]
        cells = [[np.array_split(row, BLOCKS, axis=1) for row in rows] for rows in parts]
        mean[channel] = np.array(
            [[np.mean([cell[i][j].mean() for cell in cells]) for j in range(BLOCKS)] for i in range(BLOCKS)]
        )
        pixels = np.array(
            [[sum(cell[i][j].size for cell in cells) for j in range(BLOCKS)] for i in range(BLOCKS)], float
        )
        channel_mean = mean[channel]
        temporal = (data.noise.gain * np.maximum(channel_mean, 0.0) + data.noise.read_dn**2) / pixels / len(best)
        std[channel] = np.sqrt(temporal + (data.noise.prnu * channel_mean) ** 2 / pixels)
    return Blocks(mean, std, len(best), level)


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard. Raises NotDetermined where no flats serve it."""
    yield Iso17957(side, measure_blocks(side))
