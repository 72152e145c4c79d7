"""ISO 19084:2015: chromatic displacement of red and blue from green, from the corners of a board in each channel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from lab.errors import NotDetermined
from lab.formats.results import ChannelGeometry
from lab.formats.results.estimate import Estimate
from lab.formats.results.standards import Deviation, PlotCurve, StandardPlot
from lab.standards.standard import ClauseFigure, MeasuredSide, Standard


class Iso19084(Standard):
    """ISO 19084:2015, of one channel against green."""

    name: ClassVar[str] = "ISO 19084:2015"
    title: ClassVar[str] = "chromatic displacement"
    target: ClassVar[str] = "views of a ChArUco board with a colour camera"
    compared: ClassVar[str] = "no peer on the package index; closed forms in the tests"

    def __init__(self, side: MeasuredSide, channel: ChannelGeometry) -> None:
        super().__init__(side, f"{channel.channel} against G")
        self.channel = channel
        camera = side.camera
        #: Radius of the half diagonal, px.
        self.half_diagonal_px = 0.5 * float(np.hypot(camera.rows, camera.cols))

    def _largest(self) -> int:
        return int(np.argmax(np.abs(self.channel.radial_shift_px)))

    @ClauseFigure
    def largest_radial_displacement(self) -> Estimate:
        """Return the largest radial chromatic displacement.

        Clause: 4.4. Symbol: RCD_max. Unit: px.
        Formula: r_channel − r_green of largest modulus over the image heights.
        """
        k = self._largest()
        return Estimate(value=self.channel.radial_shift_px[k], std=self.channel.radial_shift_px_std[k], unit="px")

    @ClauseFigure
    def relative_radial_displacement(self) -> Estimate:
        """Return the largest radial chromatic displacement over the image height.

        Clause: 4.4. Symbol: RCD. Unit: %.
        Formula: 100 (r_channel − r_green) / half diagonal.
        """
        largest = self.largest_radial_displacement
        factor = 100.0 / self.half_diagonal_px
        return Estimate(
            value=factor * largest.value, std=None if largest.std is None else factor * largest.std, unit="%"
        )

    @ClauseFigure
    def centre_displacement(self) -> Estimate:
        """Return the chromatic displacement on the axis.

        Clause: 4.3. Symbol: CD(0). Unit: px.
        Formula: distance of the channel's centre from that of green.
        """
        x, y = self.channel.centre_shift_px
        value = float(np.hypot(x, y))
        if self.channel.centre_shift_px_std is None:
            return Estimate(value=value, std=None, unit="px")
        std = float(np.hypot(*self.channel.centre_shift_px_std)) / float(np.sqrt(2.0))
        # a length has no sign: noise of two axes adds 2 std^2 to its square
        return Estimate(value=float(np.sqrt(max(value**2 - 2.0 * std**2, 0.0))), std=std, unit="px")

    def deviations(self) -> Iterator[Deviation]:
        yield Deviation(
            clause="3.2.2",
            quantity="chart",
            found=f"{self.channel.corners} corners of a ChArUco board in several poses",
            limit="black dots on white, parallel to the sensor",
            remedy="nothing: displacements are between channels of the same picture, whatever is in it",
        )

    def plots(self) -> Iterator[StandardPlot]:
        yield StandardPlot(
            title=f"Radial chromatic displacement of {self.channel.channel}",
            x_label="image height, px",
            y_label="displacement, px",
            curves=(
                PlotCurve(
                    label=f"{self.channel.channel} against G",
                    x=self.channel.radius_px,
                    y=self.channel.radial_shift_px,
                    y_std=self.channel.radial_shift_px_std,
                    style="points",
                    channel=self.channel.channel,
                ),
            ),
        )


def read(side: MeasuredSide) -> Iterator[Standard]:
    """Yield the standard for red and blue. Raises NotDetermined where the geometry has no channels of its own."""
    channels = [
        channel
        for channel in (side.fit.geometry.channels if side.fit.geometry is not None else ())
        if channel.radial_shift_px and channel.channel != "G"
    ]
    if not channels:
        raise NotDetermined(Iso19084.name, "no board was seen in several colours; capture a board with a colour camera")
    for channel in channels:
        yield Iso19084(side, channel)
