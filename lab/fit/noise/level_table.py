"""The noise fit on a table of channel means and variances, for recordings whose frames aren't at hand.

One row a level and channel, CSV with a header. Columns: `kind` (dark, flat), `exposure_s`, `mean_dn`, `variance_dn2`
(temporal, of single pixels), `pixels` (of the channel, over which both were taken), `repeats` (frames); where known
`channel` (Y, R, G, B), `photons_per_pixel`, `wavelength_nm`, `temperature_c`. A table holds no pattern: DSNU, PRNU and
what needs frames stay unknown."""

from __future__ import annotations

import math
from collections.abc import Hashable
from pathlib import Path

from lab.errors import InputError
from lab.fit.noise.noise_fit import noise_fit
from lab.formats.cgats import TableRow, table_rows
from lab.formats.recording_set import DataSheet
from lab.formats.results import CameraFit, ChannelNoise, Emva1288, FitResult, NoiseFit, Skipped
from lab.measure.levels import MeasuredLevel, PlaneStatistics

NEEDED = ("kind", "exposure_s", "mean_dn", "variance_dn2", "pixels", "repeats")
KNOWN = (*NEEDED, "channel", "photons_per_pixel", "wavelength_nm", "temperature_c")
#: Standard deviations below the highest code from which on a level clips.
CLIPPED_SIGMA = 4.0
#: What a table can't tell, by its name in the results.
SPATIAL = ("dsnu", "prnu", "spatial")

Setting = tuple[str, float, float | None, float | None, float | None]


def fit_level_table(file: Path, camera: DataSheet) -> FitResult:
    """Photon transfer from the table `file`, of a camera whose `cfa`, `bit_depth` and levels `camera` states.

    Raises InputError with one line where a column is missing or unknown (another unit, above all) or a cell is no
    number, and `NotDetermined` where the levels don't determine the conversion gain.
    """
    groups: dict[Setting, dict[str, PlaneStatistics]] = {}
    for row in table_rows(file, NEEDED, KNOWN):
        channel = row.cells.get("channel") or ("Y" if camera.cfa == "MONO" else "")
        if channel not in camera.channels:
            raise InputError(
                f"{file}: row {row.number}: channel '{channel}' of a {camera.cfa} sensor; write "
                f"{', '.join(camera.channels)}"
            )
        setting, plane = _level(row, camera)
        if channel in groups.setdefault(setting, {}):
            raise InputError(
                f"{file}: row {row.number}: channel {channel} of this level stands twice; take one row out"
            )
        groups[setting][channel] = plane
    darks: list[MeasuredLevel] = []
    flats: list[MeasuredLevel] = []
    for (kind, exposure_s, photons, wavelength_nm, temperature_c), planes in groups.items():
        if set(planes) != set(camera.channels):
            raise InputError(
                f"{file}: {kind} of {exposure_s:g} s: channels {', '.join(planes)}; give all of "
                f"{', '.join(camera.channels)}"
            )
        dark = kind == "dark"
        light = 0.0 if dark else exposure_s if photons is None else photons
        lamp: Hashable = "dark" if dark else (None, photons is not None, wavelength_nm)
        (darks if dark else flats).append(MeasuredLevel(exposure_s, light, lamp, planes, temperature_c))
    if not flats:
        raise InputError(f"{file}: no flats; give three levels or more")
    fitted = _without_patterns(noise_fit(darks, flats, camera))
    reason = "a table of means and variances holds no frames"
    skipped = tuple(Skipped(step=step, reason=reason, side="left") for step in ("spectral", "mtf", "psf", "geometry"))
    return FitResult(source=str(file), cameras={"left": CameraFit(noise=fitted)}, skipped=skipped)


def _level(row: TableRow, camera: DataSheet) -> tuple[Setting, PlaneStatistics]:
    kind = row.cells["kind"]
    if kind not in ("dark", "flat"):
        raise InputError(f"{row.file}: row {row.number}: kind '{kind}'; write dark or flat")
    mean, variance = row.value("mean_dn"), row.value("variance_dn2")
    if mean > camera.saturation_dn:
        raise InputError(
            f"{row.file}: row {row.number}: mean_dn = {mean:g} is above the highest code {camera.saturation_dn:g}; "
            "correct one"
        )
    pixels, repeats = int(row.value("pixels", 1.0)), int(row.value("repeats", 1.0))
    is_clipped = mean > camera.saturation_dn - CLIPPED_SIGMA * math.sqrt(variance) - 0.5
    std = variance * math.sqrt(2.0 / (max(repeats - 1, 1) * pixels))
    side = max(round(math.sqrt(pixels)), 2)
    plane = PlaneStatistics(
        pixels=pixels, mean=mean, frame_means=(mean,) * repeats,
        temporal_variance=variance if repeats > 1 else math.nan,
        temporal_variance_std=std, spatial_variance=0.0, spatial_variance_std=0.0, pattern_variance=0.0,
        pattern_variance_std=0.0, defects=0,
        clipped_share=1.0 if is_clipped else 0.0, piled_share=0.0, zero_share=0.0, highest=mean, shape=(side, side),
        mean_of_all=mean,
        temporal_variance_of_all=variance,
    )  # fmt: skip
    setting = (
        kind,
        row.value("exposure_s"),
        row.known("photons_per_pixel"),
        row.known("wavelength_nm"),
        row.known("temperature_c", -273.15),
    )
    return setting, plane


def _without_patterns(fit: NoiseFit) -> NoiseFit:
    """Return the fit less the figures that need frames."""

    def emptied(part: NoiseFit | ChannelNoise | Emva1288) -> dict[str, object]:
        return {name: None for name in type(part).model_fields if name.startswith(SPATIAL)}

    channels = {c: part.model_copy(update=emptied(part)) for c, part in fit.channels.items()}
    figures = {}
    for c, part in fit.emva1288.items():
        remarks = tuple(text for text in part.remarks if not text.startswith("the spatial stacks"))
        figures[c] = part.model_copy(update=emptied(part) | {"remarks": remarks})
    remark = "of a table of means and variances: DSNU, PRNU, shading and defects aren't determined"
    update = emptied(fit) | {"channels": channels, "emva1288": figures, "remarks": (*fit.remarks, remark)}
    return fit.model_copy(update=update)
