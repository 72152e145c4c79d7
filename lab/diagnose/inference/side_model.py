"""Make the measurement model of one side: all measurements that its recordings determine, and the baseline camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lab.capture_kinds.flat import FlatCapture
from lab.diagnose.inference.measurement_model import MeasurementModel
from lab.errors import NotDetermined
from lab.formats.camera_file import CameraFile
from lab.formats.camera_model import assumptions, camera_model
from lab.formats.recording_set import RecordingSet
from lab.formats.results import CameraFit, FitResult, Skipped
from lab.observables.dataset import Dataset
from lab.observables.flats.linearity import misstated_levels
from lab.observables.noise.levels import LEAST_REACH
from lab.observables.observable import measurements
from sim.camera import Side
from sim.effects.pixel_aperture import PixelAperture
from sim.spectrum import FloatArray

#: Where the fill factor isn't stated: least side of the pixel's aperture (px), number of sides tried between it and 1,
#: and number of principal components that stand for their changes.
LEAST_SIDE, APERTURES, APERTURE_DIRECTIONS = 0.5, 10, 4
#: Remark on an assumed quantity that has nuisance parameters.
FREE_BESIDE = {"fill_factor": ", but contrast may be that of any aperture"}
#: Remark where nothing tells the conversion gain.
NO_GAIN = (
    "neither stated nor measured: what is told in electrons elsewhere is told in DN, and the improved model takes 1 "
    "DN/e; capture repeated flats at "
    "three levels, or state it"
)
#: Share of the fitted full well from which on a pixel counts as clipped, as noise takes some pixels of that level to
#: the full well.
_NEAR_FULL = 0.985


def dataset_of(
    recordings: RecordingSet, side: Side, fit: FitResult | None = None, baseline: CameraFile | None = None
) -> Dataset:
    """Return the dataset of one side, with the baseline camera that `measurement_model` describes."""
    camera_fit = fit.cameras.get(side) if fit is not None else None
    camera = baseline.camera if baseline else camera_model(recordings, side, camera_fit, maker_curves=True)
    misstated = frozenset(name for level in misstated_levels(camera_fit) for name in level.captures)
    noise = camera_fit.noise if camera_fit else None
    return Dataset(recordings, side, camera, _saturation_dn(camera_fit), misstated, noise)


def measurement_model(
    recordings: RecordingSet,
    side: Side,
    fit: FitResult | None = None,
    baseline: CameraFile | None = None,
    dataset: Dataset | None = None,
) -> tuple[MeasurementModel | None, tuple[Skipped, ...]]:
    """Return the measurement model of one side (None where no measurement is determined), and what was skipped or
    assumed.

    The baseline camera is made of the data sheet and of the side's `fit`. `baseline` stands in place of both: a camera
    file, whose effects are then part of the baseline. `dataset`: that of `dataset_of`, where it is there already."""
    camera_fit = fit.cameras.get(side) if fit is not None else None
    skipped = [
        Skipped(
            step=f"diagnose {a.quantity}",
            reason=f"neither stated nor fitted; taken as {a.value}{FREE_BESIDE.get(a.quantity, '')}",
            side=side,
        )
        for a in assumptions(recordings.camera(side), camera_fit)
    ]
    dataset = dataset or dataset_of(recordings, side, fit, baseline)
    skipped += [Skipped(step="diagnose recordings", reason=reason, side=side) for reason in dataset.copies.told]
    if not dataset.noise.gain_is_known:
        skipped.append(Skipped(step="diagnose conversion_gain_dn_per_e", reason=NO_GAIN, side=side))
    skipped += _far_from_full(dataset)
    blocks = []
    for measurement in measurements():
        try:
            blocks.append(measurement.make(dataset))
        except NotDetermined as refused:
            skipped.append(Skipped(step=f"diagnose {refused.step}", reason=refused.reason, side=side))
    blocks = [b for b in blocks if any(not label.held_out for label in b.labels)]
    always = baseline.effects if baseline is not None else ()
    if not blocks:
        return None, tuple(skipped)
    known = dataset.noise.gain_is_known
    model = MeasurementModel(tuple(blocks), dataset.camera, always, gain_is_known=known, noise=dataset.noise)
    if dataset.stated.fill_factor is None and baseline is None:
        model = replace(model, unstated_jacobian=any_aperture(model))
    return model, tuple(skipped)


def _far_from_full(dataset: Dataset) -> list[Skipped]:
    """Return a remark where no flat reaches `LEAST_REACH` of the full well, to which parameters of the response
    refer."""
    flats = dataset.recordings.captures(FlatCapture, dataset.side)
    highest = max((level for flat in flats for level in dataset.levels(flat).whole.values()), default=np.inf)
    reach = (highest - dataset.noise.black) / (dataset.saturation_dn - dataset.noise.black)
    if reach >= LEAST_REACH:
        return []
    reason = (
        f"the brightest flat reaches {100 * reach:.2g} % of it, {100 * LEAST_REACH:.0f} % are needed: parameters that "
        "refer to full well (nonlinearity's, "
        "brighter-fatter's) are extrapolated from there, and hold for signals up to "
        f"{highest - dataset.noise.black:.4g} DN; expose longer, or correct "
        "bit_depth or white_level_dn"
    )
    return [Skipped(step="diagnose full_well_e", reason=reason, side=dataset.side)]


def any_aperture(model: MeasurementModel, used: int | None = None) -> dict[str, FloatArray]:
    """Jacobian by an unstated pixel aperture: name -> (n,) per prior standard deviation.

    The changes of the predicted mean by `APERTURES` sides, evenly spaced from `LEAST_SIDE` to 1 px, are divided by
    sqrt(`APERTURES`). The columns are the principal components of these, each times its singular value: those of the
    first `used` numbers (None: of all), by which the same apertures change the others.
    """
    camera, sides = model.camera, np.linspace(LEAST_SIDE, 1.0, APERTURES, endpoint=False)
    lowest = PixelAperture.quantities()["side_change_um"].lower or -np.inf
    effects = [PixelAperture(side_change_um=max(lowest, (s - 1.0) * camera.pixel_pitch_um)) for s in sides]
    changes = (np.array([model.mean((e,)) for e in effects]) - model.mean()) / np.sqrt(APERTURES)
    mixture, size, _ = np.linalg.svd(changes[:, :used], full_matrices=False)
    most = min(APERTURE_DIRECTIONS, len(size))
    return {f"aperture:{k}": mixture[:, k] @ changes for k in range(most) if size[k] > 0.0}


def _saturation_dn(fit: CameraFit | None) -> float | None:
    """Code (DN) from which on a pixel counts as clipped, by the fitted full well; None where it isn't fitted."""
    noise = fit.noise if fit is not None else None
    if noise is None or noise.full_well_e is None or noise.conversion_gain_dn_per_e is None:
        return None
    return (noise.black_level_dn or 0.0) + _NEAR_FULL * noise.full_well_e * noise.conversion_gain_dn_per_e
