"""Rows that differ in even light, and do so again after a period: means of the rows of flat fields by their place in
it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.errors import NotDetermined
from lab.observables.darks.readout import OFFSETS_STD, dark_readout
from lab.observables.dataset import Dataset
from lab.observables.flats.images import collect_rows, flats, without_dark
from lab.observables.noise.robust import median_std
from lab.observables.observable import Label, Measurement, Observable, Prediction
from lab.observables.reads import COLLECTED, acting
from sim.effects.base import Effects
from sim.sensor import mosaic
from sim.spectrum import FloatArray

#: Rows of a period, of which what repeats after fewer is a part: 2, 3, 4, 6, 8, 12, 16 and 24 rows. Low frames: half.
PERIOD, LOW_PERIOD = mosaic.PERIOD_PX, mosaic.PERIOD_PX // 2
LEAST_PERIODS = 3  # of a frame, one of which its ends lose


@dataclass(frozen=True)
class _Rows:
    """How rows become means by their place in the period, (n,): linear in the rows (rows,)."""

    rows: int
    period: int

    @staticmethod
    def of(rows: int) -> _Rows:
        """Raises NotDetermined for too few rows."""
        for period in (PERIOD, LOW_PERIOD):
            if rows >= LEAST_PERIODS * period:
                return _Rows(rows, period)
        raise NotDetermined(
            "row_periods",
            f"frames of {rows} rows: rows that repeat are told from the light's slope from "
            f"{LEAST_PERIODS * LOW_PERIOD} rows on",
        )

    def rough(self, line: FloatArray) -> FloatArray:
        """Rows without what is smooth over a period, (rows - period,): less the mean over a period about each."""
        box = np.ones(self.period + 1)
        box[[0, -1]] = 0.5
        half = self.period // 2
        return np.asarray(line[half:-half] - np.convolve(line, box / self.period, mode="valid"))

    @property
    def place(self) -> NDArray[np.intp]:
        """Place in the period of each of the rows that `rough` leaves."""
        half = self.period // 2
        return np.arange(half, self.rows - half) % self.period

    def means(self, line: FloatArray) -> FloatArray:
        """Means (period,) of the rough rows by place, less their mean."""
        found = np.bincount(self.place, self.rough(line)) / np.bincount(self.place)
        return np.asarray(found - found.mean())

    def spread(self, line: FloatArray, least: float) -> float:
        """Standard deviation of a row by all that doesn't repeat: from rows one period apart, `least` by derived
        noise."""
        rough = self.rough(line)
        away = (rough[self.period :] - rough[: -self.period]) / np.sqrt(2.0)
        return median_std(away, least)


def measure_row_periods(dataset: Dataset) -> Observable:
    """Means of the rows of the mean flat field by their place in a period of 48 rows, relative to the mean signal.

    In a mosaic even and odd pixels of the rows are apart, each colour's plane over its mean. What is smooth over a
    period is the light's. What dark frames have is subtracted, and may be another in light by `OFFSETS_STD`. The
    standard deviation of a row is that by noise and PRNU, or that of rows one period apart where these differ more.
    Raises NotDetermined without unclipped flats, and for frames too low.
    """
    levels, images = dataset.once(flats)
    if not images:
        raise NotDetermined("row_periods", "no unclipped flat captures")
    rows, step = _Rows.of(dataset.camera.rows), mosaic.step(dataset.camera.cfa)
    dark = dataset.once(dark_readout)
    count = np.bincount(rows.place)
    values: list[FloatArray] = []
    labels: list[Label] = []
    own: list[FloatArray] = []
    shared: list[FloatArray] = []
    for held_out, (whole_image, noise) in sorted(images.items()):
        part = [u for u in levels if u.held_out == held_out]
        members = tuple(c.id for u in part for c in u.captures)
        image, of_dark = (whole_image, 0.0) if dark is None else without_dark(dataset, dark, part, whole_image)
        for first in range(step):
            line, with_dark = (
                np.asarray(one[:, first::step].mean(axis=1, dtype=float)) for one in (image, whole_image)
            )
            pixels = dataset.camera.cols // step
            least2 = (dataset.noise.prnu**2 + of_dark + noise) / pixels
            row2 = rows.spread(line, float(np.sqrt(least2))) ** 2 / count
            shot2 = np.minimum(noise / pixels / count, row2)
            values.append(rows.means(line))
            own.append(shot2)
            subtracted = OFFSETS_STD * rows.means(with_dark - line)
            shared.append(row2 - shot2 + np.square(subtracted))
            name = "row" if step == 1 else f"row, {('even', 'odd')[first]} columns"
            labels += [Label(float(k), "all", f"{name} {k}", members, held_out) for k in range(rows.period)]
    # the means lack their own mean: of 48 numbers, each has 2 % less variance than is said here
    covariance = np.zeros((len(labels),) * 2)
    for i in range(len(own)):
        for j in range(len(own)):
            if i % step == j % step:  # the same pixels, seen and held out: only the noise is another
                at = tuple(np.arange(k * rows.period, (k + 1) * rows.period) for k in (i, j))
                covariance[at] = np.minimum(shared[i], shared[j]) + (own[i] if i == j else 0.0)

    def predict(effects: Effects) -> Prediction:
        collecting = acting(effects, COLLECTED)
        if not collecting:
            return Prediction(np.zeros(len(labels)), {})
        collected = collect_rows(dataset.camera, collecting)
        one = np.concatenate([rows.means(line) for line in collected.T])
        return Prediction(np.tile(one, len(images)), {})

    return Observable(
        measurement=ROW_PERIODS, reach=1.0, value=np.concatenate(values), covariance=covariance, labels=tuple(labels),
        reads=COLLECTED, predict=predict, scale=np.ones(len(labels)),
    )  # fmt: skip


ROW_PERIODS = Measurement(
    "row_periods",
    title="rows of flat fields that repeat",
    order=262,
    axis="row",
    unit="px",
    make=measure_row_periods,
    quantity="departure from the mean signal",
)
