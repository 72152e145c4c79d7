"""The monochromator abstraction: light of one wavelength, with a shutter, slits and a wheel of order-sorting
filters."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.errors import InstrumentError
from drivers.instrument import Instrument, Setting

#: Attempts to close the shutter and read its state.
SHUT_ATTEMPTS = 2


@dataclass(frozen=True)
class OrderSortingFilter:
    """One position of the filter wheel, and the wavelengths (nm, the upper end excluded) for which it is used.

    A grating that passes w in first order also passes w/2 in second order: a band's filter must block half of every
    wavelength in it and transmit the band itself.
    """

    place: int
    from_nm: float
    to_nm: float


#: Open up to 400 nm, then long-pass filters with cut-ons at about 375, 550 and 780 nm.
ORDER_SORTING_FILTERS = (
    OrderSortingFilter(1, 0.0, 400.0),
    OrderSortingFilter(2, 400.0, 640.0),
    OrderSortingFilter(3, 640.0, 1000.0),
    OrderSortingFilter(4, 1000.0, 1400.0),
)


def order_sorting_filters(table: Sequence[object] | None) -> tuple[OrderSortingFilter, ...]:
    """Return the filter table of a station file, checked; the default table where there is none.

    table : rows of `place`, `from_nm`, `to_nm`

    Raises `InstrumentError` for a row that lacks a key, an empty or overlapping band.

    >>> [row.place for row in order_sorting_filters([{"place": 1, "from_nm": 300, "to_nm": 600}])]
    [1]
    """
    if table is None:
        return ORDER_SORTING_FILTERS
    rows: list[OrderSortingFilter] = []
    for row in table:
        if isinstance(row, OrderSortingFilter):
            rows.append(row)
            continue
        try:
            rows.append(OrderSortingFilter(int(row["place"]), float(row["from_nm"]), float(row["to_nm"])))  # type: ignore[index]
        except (KeyError, TypeError, ValueError) as error:
            raise InstrumentError(
                f"monochromator: row {row!r} of filters can't be used; give place, from_nm and to_nm"
            ) from error
    rows.sort(key=lambda row: row.from_nm)
    for row in rows:
        if not row.from_nm < row.to_nm:
            raise InstrumentError(
                f"monochromator: filter {row.place} serves {row.from_nm}..{row.to_nm} nm; give a band that isn't empty"
            )
    for before, after in itertools.pairwise(rows):
        if after.from_nm < before.to_nm:
            raise InstrumentError(
                f"monochromator: filters {before.place} and {after.place} both serve {after.from_nm} nm; give bands "
                "that don't overlap"
            )
    return tuple(rows)


def filter_place(filters: Sequence[OrderSortingFilter], wavelength_nm: float) -> int:
    """Choose the position of the order-sorting filter for a wavelength.

    filters : rows of the table; wavelength_nm : nm

    Returns the place. Raises `InstrumentError` where no row holds the wavelength.

    >>> filter_place([OrderSortingFilter(2, 350.0, 600.0)], 550.0)
    2
    """
    for row in filters:
        if row.from_nm <= wavelength_nm < row.to_nm:
            return row.place
    bands = ", ".join(f"{row.from_nm:g}..{row.to_nm:g}" for row in filters)
    raise InstrumentError(
        f"monochromator: no order-sorting filter for {wavelength_nm:g} nm, the table serves {bands} nm; "
        "without one, light of half the wavelength passes: extend `filters` in the station file"
    )


class Monochromator(Instrument):
    """A monochromator behind a light source. `stop` and `close` leave the shutter closed.

    One without a shutter has something in its place: a blank in the filter wheel, or a wavelength at which its lamp
    gives no light. It is parked there, and moves to the wavelength that was set when it is opened.
    """

    #: Whether light may get out, as far as this driver's own commands and the instrument's answers say.
    _may_shine = False

    def _shut_for_good(self) -> InstrumentError | None:
        """Close the shutter and read it back, a second time where that fails. Returns why it can't be said to be
        closed, or None."""
        failure: InstrumentError | None = None
        for attempt in range(SHUT_ATTEMPTS):
            try:
                if self._is_shut(again=attempt > 0):
                    self._may_shine = False
                    return None
                failure = failure or InstrumentError(
                    "monochromator: its shutter is open after the command to close; block the light by hand"
                )
                self._may_shine = True
            except InstrumentError as error:
                failure = failure or error
                if not self._may_shine:
                    return None  # it can't be asked, and wasn't opened
        return InstrumentError(f"monochromator: its shutter may be open ({failure}); block the light by hand")

    def _is_shut(self, again: bool) -> bool:
        """Close the shutter and return whether the instrument says that it is closed; `again`: after a failure."""
        self.stop()
        return not self.shutter_is_open()

    def shut_at_once(self) -> bool:
        """Close the shutter before any other command: the first thing after a crash, and in a halt.

        Returns whether the instrument answered that it is closed; False where it needs to be spoken to first. `connect`
        and `stop` follow in any case. Raises `InstrumentError` where it isn't reached.
        """
        return False

    def settings(self) -> dict[str, Setting]:
        return {"bandwidth_nm": self.bandwidth_nm(), "filter_place": self.selected_filter()}

    @abstractmethod
    def move_nm(self, wavelength_nm: float) -> None:
        """Go to a wavelength (nm; 0 is zero order, white light) with its order-sorting filter; returns on arrival."""

    def check_nm(self, wavelength_nm: float) -> None:
        """Raise `InstrumentError` for a wavelength (nm) that `move_nm` would refuse, as far as the driver knows;
        nothing moves."""
        return

    def check_slit_um(self, width_um: float) -> None:
        """Raise `InstrumentError` for a slit width (um) that `set_slit_um` would refuse, as far as the driver knows;
        nothing moves."""
        return

    @abstractmethod
    def wavelength_nm(self) -> float:
        """Return the wavelength (nm) that the instrument reports."""

    @abstractmethod
    def open_shutter(self) -> None:
        """Let light out."""

    @abstractmethod
    def close_shutter(self) -> None:
        """Keep light in."""

    @abstractmethod
    def shutter_is_open(self) -> bool:
        """State of the shutter that the instrument reports."""

    @abstractmethod
    def select_filter(self, place: int) -> None:
        """Turn the filter wheel to a position; `move_nm` does so by itself."""

    @abstractmethod
    def selected_filter(self) -> int:
        """Return the position of the filter wheel."""

    @abstractmethod
    def slit_um(self) -> float:
        """Return the width (um) of the entrance slit; the exit slit is kept at the same width."""

    @abstractmethod
    def set_slit_um(self, width_um: float) -> None:
        """Set entrance and exit slits to one width (um)."""

    @abstractmethod
    def bandwidth_nm(self) -> float:
        """Return the full width at half maximum (nm) of the light: slit width x reciprocal linear dispersion of the
        grating in use.

        0 where it isn't known, as the slits are set by hand and their width isn't stated; `departures` says so.
        """


#: Narrowest and widest slit (um) of the motorised slits of Cornerstone 260 and CS260B.
SLIT_LIMITS_UM = (4.0, 3000.0)


def check_slit_um(width_um: float) -> float:
    """Check a slit width.

    width_um : um

    Returns it. Raises `InstrumentError` where the slits can't be set to it (a NaN included).

    >>> check_slit_um(500.0)
    500.0
    """
    low, high = SLIT_LIMITS_UM
    if not low <= width_um <= high:
        raise InstrumentError(
            f"monochromator: a slit of {width_um:g} um is outside {low:g}..{high:g} um; ask for a width in this range"
        )
    return width_um


#: Reciprocal linear dispersion (nm/mm) of Cornerstone 260 and CS260B, times the grating's lines per mm: 1e6 nm/mm x
#: cos(9.6 deg) / 260 mm.
DISPERSION_NM = 1e6 / 260.0 * math.cos(math.radians(9.6))
#: What the instruments say of slits that aren't motorised: no such accessory, or a statement that isn't known.
NO_SLIT = {1, 6, -113, -241}


@dataclass(frozen=True)
class HandSlits:
    """Slits that a micrometer sets: what is known of them is the width (um) that the station file states, or
    nothing."""

    stated_um: float | None

    def set(self, wanted_um: float, who: str) -> None:
        """Raise `InstrumentError` unless they have this width (um) already."""
        if self.stated_um is None or abs(self.stated_um - wanted_um) > 0.5:
            raise InstrumentError(
                f"{who}: its slits are set by hand, and slit_um in its table of the station file says "
                f"{self.stated_um}; turn them to "
                f"{wanted_um:g} um and state that there"
            )

    def departures(self, who: str) -> tuple[str, ...]:
        """Return what isn't known of the light, in words."""
        if self.stated_um is not None:
            return ()
        return (f"{who}: its slits are set by hand, and no slit_um is stated: the bandwidth of its light isn't known",)


def lines_per_mm(text: str, who: str) -> float:
    """Read the lines per mm of the grating in use from the answer to GRAT?.

    text : `1,1200,VIS`; who : the instrument, for messages

    Returns lines per mm. Raises `InstrumentError` for another answer.

    >>> lines_per_mm("1,1200,VIS", "Cornerstone 260")
    1200.0
    """
    try:
        lines = float(text.split(",")[1])
    except (IndexError, ValueError):
        lines = 0.0
    if not lines > 0.0:
        raise InstrumentError(
            f"{who}: says {text!r} of its grating, which has no lines per mm; state dispersion_nm_per_mm in the "
            "station file"
        )
    return lines


def check_wavelength_nm(wavelength_nm: float, upper_nm: float) -> float:
    """Check a wavelength.

    wavelength_nm, upper_nm : nm, and the highest that the grating reaches

    Returns it. Raises `InstrumentError` where the grating can't go there (a NaN included).

    >>> check_wavelength_nm(550.0, 1400.0)
    550.0
    """
    if not (math.isfinite(wavelength_nm) and 0.0 <= wavelength_nm <= upper_nm):
        raise InstrumentError(
            f"monochromator: {wavelength_nm} nm is outside 0..{upper_nm:g} nm; ask for a wavelength in this range"
        )
    return wavelength_nm
