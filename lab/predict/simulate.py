"""`calibench simulate`: one raw frame of a named scene, with a preview and a record from which it can be made again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from lab.errors import InputError
from lab.formats.camera_file import CameraFile, default_camera, read_camera, trace_table
from lab.formats.raw_file import (
    Frame,
    RawMetadata,
    colour_matrix,
    daylight,
    electrons_of,
    replacing,
    write_raw,
    writer_of,
)
from lab.formats.result_file import installed_versions
from lab.formats.scene_file import light, scene
from lab.shown import Displayable
from sim import frame as sim_frame
from sim.camera import CameraModel, Geometry, Lens
from sim.effects.distortion import Distortion
from sim.frame import Exposure
from sim.optics.imaging import TracedLens
from sim.parameters import Frozen, Quantity
from sim.scene.catalogue import View
from sim.scene.warp import rays
from sim.sensor import electrons as sensor
from sim.sensor.electrons import FixedPattern
from sim.spectrum import FloatArray, Spectrum

Progress = Callable[[str, float], None]

#: The automatic exposure: the brightest 1 % of the pixels reach 70 % of their capacity.
BRIGHTEST_PERCENT, AUTO_SHARE = 1.0, 0.7
#: Limits of the automatic exposure (s).
SHORTEST_S, LONGEST_S = 1e-6, 3600.0
#: Angle from the axis up to which scenes are placed by a pinhole. A frame to 40 deg is drawn with a margin to about 70,
#: where the search of the place that light comes from still ends (`sim.plain_image`); from 42 deg on it doesn't.
WIDEST_SCENE_DEG = 40.0


class SimulateOptions(Frozen):
    """The options of a simulated frame. Together with the camera they determine it."""

    scene: str
    parameters: dict[str, float] = {}
    illuminant: str = "D65"
    luminance_cd_m2: Annotated[
        float | None, Quantity("cd/m^2", "luminance of a perfect white diffuser in the scene's place", lower=0.0)
    ] = None
    distance_mm: Annotated[float, Quantity("mm", "distance of the scene from the lens", lower=0.0)] = 1000.0
    exposure_s: Annotated[float | None, Quantity("s", "exposure; none: automatic", lower=0.0)] = None
    gain_db: Annotated[float, Quantity("dB", "analogue gain", lower=-60.0, upper=60.0)] = 0.0
    temperature_c: Annotated[float | None, Quantity("C", "temperature of the sensor", lower=-273.0, upper=200.0)] = None
    seed: Annotated[int, Quantity("1", "seed of the frame's noise", lower=0)] = 0
    pattern_seed: Annotated[
        int, Quantity("1", "seed of the camera's fixed patterns: which camera of its kind", lower=0)
    ] = 0
    expected: bool = False


class Summary(Frozen):
    """Statistics of a frame. Electrons are expected values, without noise; `snr` is the signal-to-noise ratio of a
    pixel at the mean level."""

    exposure_s: float
    automatic_exposure: bool
    mean_electrons: float
    brightest_percent_electrons: float
    mean_dn: float
    highest_dn: int
    saturated_percent: float
    snr: float


class SimulationRecord(Frozen):
    """The record beside the frame, as JSON. `camera_sha256` is the hash of the camera model and its effects."""

    format: str = "calibench-simulation"
    version: int = 1
    file: str
    frame_sha256: str
    options: SimulateOptions
    camera_name: str
    camera_sha256: str
    camera: dict[str, Any]
    effects: list[dict[str, Any]]
    prescription: str | None
    lens_warnings: tuple[str, ...]
    magnification: float
    summary: Summary
    versions: dict[str, str]


@dataclass(frozen=True, eq=False, repr=False)  # an IPython prompt prefers a dataclass's own text
class Simulation(Displayable):
    """A simulated frame (rows, cols) in DN, its camera, the spectral radiance of the scene's white, and the record."""

    frame: Frame
    camera: CameraModel
    white: Spectrum
    record: SimulationRecord


def camera_for(
    camera: Path | None, lens: Path | None, cache: Path | None = None, progress: Progress | None = None
) -> CameraFile:
    """Return the camera of a file, or the default camera (None). With `lens`, a prescription, its f-number and focal
    length are that lens's.

    Raises InputError for a file that can't be used.
    """
    content = default_camera() if camera is None else read_camera(camera, cache, progress)
    if lens is None:
        return content
    return with_lens(content, lens, cache, progress)


def with_lens(
    content: CameraFile, lens: Path, cache: Path | None = None, progress: Progress | None = None
) -> CameraFile:
    """Return the camera with the lens of a prescription, f-number and focal length included. Raises InputError for a
    file that can't be used."""
    table = trace_table(lens, cache, progress)
    model = content.camera
    try:
        traced = Lens(
            f_number=table.f_number,
            focal_length_mm=table.focal_length_mm,
            transmittance=model.lens.transmittance,
            imaging=TracedLens(table=table),
        )
    except ValidationError as error:
        raise InputError(f"{lens}: {_line(error)}") from error
    return replace(content, camera=model.model_copy(update={"lens": traced}), prescription=lens)


def simulate(options: SimulateOptions, content: CameraFile, progress: Progress | None = None) -> Simulation:
    """One frame: scene -> electrons -> codes. The same options and camera give the same frame.

    Raises InputError for a scene, a light or an exposure that can't be used: no light where the sensor sees, every
    pixel full."""
    tell = progress or (lambda text, share: None)
    content = _distorting(content)
    camera = content.camera
    tell("scene", 0.05)
    white = light(options.illuminant, options.luminance_cd_m2)
    try:
        shown = scene(
            options.scene, camera, white, distance_mm=options.distance_mm, parameters=options.parameters or None
        )
        magnification = View.of(camera, options.distance_mm).magnification

        def exposed(seconds: float) -> Exposure:
            return Exposure(
                shown,
                seconds,
                gain_db=options.gain_db,
                temperature_c=options.temperature_c,
                magnification=magnification,
            )

        tell("optics", 0.1)
        each_second = sim_frame.expected_electrons(camera, exposed(1.0), content.effects)
        dark = sim_frame.dark_electrons(camera, exposed(1.0), content.effects)
        _check_light(each_second, dark, options, white, camera)
        seconds = options.exposure_s
        if seconds is None:
            seconds = automatic_exposure_s(each_second, camera, options.gain_db)
        exposure = exposed(seconds)
        proportional = sim_frame.grows_with_exposure(camera, content.effects)
        electrons = (
            each_second * seconds
            if proportional
            else sim_frame.expected_electrons(
                camera,
                exposure,
                content.effects,
                source=sim_frame.unsteady_source(camera, content.effects, exposure.elapsed_s),
            )
        )
        sim_frame.check_not_saturated(camera, exposure, electrons)
        tell("sensor", 0.8)
        frame = _read(electrons, camera, content, exposure, options)
    except ValueError as error:
        raise InputError(_line(error)) from error
    return Simulation(
        frame, camera, white, _record(frame, electrons, exposure, options, content, camera, magnification)
    )


def _distorting(content: CameraFile) -> CameraFile:
    """Add the distortion of the camera's geometry as an effect, because named scenes are projected by a pinhole. A
    traced lens brings its own distortion."""
    camera = content.camera
    straight = camera.geometry is None or camera.geometry.is_ideal
    if straight or isinstance(camera.lens.imaging, TracedLens):
        return content
    assert camera.geometry is not None
    _check_field(camera, camera.geometry)
    return replace(content, effects=(*content.effects, Distortion(geometry=camera.geometry)))


def _check_field(camera: CameraModel, geometry: Geometry) -> None:
    """Raise InputError where a corner of the frame of a fisheye sees farther from the axis than a pinhole can place
    scenes.
    """
    if geometry.projection == "pinhole":
        return
    row, col = np.array([0.0, 0.0, 1.0, 1.0]) * (camera.rows - 1), np.array([0.0, 1.0, 0.0, 1.0]) * (camera.cols - 1)
    directions = rays(col, row, geometry)
    angle_deg = np.rad2deg(np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2]))
    if not np.all(angle_deg <= WIDEST_SCENE_DEG):
        raise InputError(
            f"the corner of the frame sees {np.nanmax(angle_deg):.0f} deg off the axis ({geometry.projection} "
            f"projection), and scenes are placed by a pinhole, up to {WIDEST_SCENE_DEG:g} deg: give a camera file with "
            "fewer rows and columns"
        )


def automatic_exposure_s(electrons_per_s: FloatArray, camera: CameraModel, gain_db: float = 0.0) -> float:
    """Return the exposure (s, three digits) at which the brightest 1 % of the pixels reach 70 % of their capacity.
    Raises InputError beyond the limits."""
    bright = float(np.percentile(electrons_per_s, 100.0 - BRIGHTEST_PERCENT))
    bright = bright if bright > 0 else float(electrons_per_s.max())
    seconds = AUTO_SHARE * sensor.capacity_e(camera, gain_db) / bright
    if not SHORTEST_S <= seconds <= LONGEST_S:
        raise InputError(
            f"the brightest pixels collect {bright:.3g} e/s: an exposure of {seconds:.3g} s would be needed, beyond "
            f"the limits of {SHORTEST_S:g} and {LONGEST_S:g} s; give --exposure-s, or another light"
        )
    return float(f"{seconds:.3g}")


def _read(
    electrons: FloatArray, camera: CameraModel, content: CameraFile, exposure: Exposure, options: SimulateOptions
) -> Frame:
    read_out = sim_frame.read_out(camera, exposure, content.effects)
    if options.expected:
        mean, _ = sensor.dn_moments(electrons, camera, exposure.gain_db, read_out)
        return np.clip(np.rint(mean), 0.0, camera.white_level_dn).astype(np.uint16)
    return sensor.sample_from(
        electrons,
        camera,
        np.random.default_rng(options.seed),
        FixedPattern.draw(camera, np.random.default_rng([options.pattern_seed, 1])),
        dark_electrons=sim_frame.dark_electrons(camera, exposure, content.effects),
        gain_db=exposure.gain_db,
        read_out=read_out,
    )


def _check_light(
    electrons: FloatArray, dark: FloatArray | float, options: SimulateOptions, white: Spectrum, camera: CameraModel
) -> None:
    asked_for = options.luminance_cd_m2 == 0.0 and options.exposure_s is not None  # a dark frame
    if asked_for or np.any(electrons > dark):
        return
    curves = camera.quantum_efficiency.values()
    sensitive_nm = min(c.wavelength_nm[0] for c in curves), max(c.wavelength_nm[-1] for c in curves)
    raise InputError(
        f"scene {options.scene!r} under {options.illuminant!r} makes no electrons: its light runs from "
        f"{white.wavelength_nm[0]:g} to {white.wavelength_nm[-1]:g} nm, the sensor sees {sensitive_nm[0]:g} to "
        f"{sensitive_nm[1]:g} nm; give a light with power there"
    )


def _record(
    frame: Frame,
    electrons: FloatArray,
    exposure: Exposure,
    options: SimulateOptions,
    content: CameraFile,
    camera: CameraModel,
    magnification: float,
) -> SimulationRecord:
    full = sensor.capacity_e(camera, exposure.gain_db)
    level = np.array([[float(np.mean(electrons))]])
    mean, variance = sensor.dn_moments(level, camera, exposure.gain_db)
    imaging = camera.lens.imaging
    described = camera.model_dump(mode="json")
    effects = [{"name": effect.name, **effect.model_dump(mode="json")} for effect in content.effects]
    return SimulationRecord(
        file="",
        frame_sha256=hashlib.sha256(frame.astype("<u2").tobytes()).hexdigest(),
        options=options.model_copy(update={"exposure_s": exposure.exposure_s}),
        camera_name=content.name,
        camera_sha256=camera_sha256(content),
        camera=described,
        effects=effects,
        prescription=None if content.prescription is None else str(content.prescription),
        lens_warnings=imaging.table.warnings if isinstance(imaging, TracedLens) else (),
        magnification=magnification,
        summary=Summary(
            exposure_s=exposure.exposure_s,
            automatic_exposure=options.exposure_s is None,
            mean_electrons=float(level.item()),
            brightest_percent_electrons=float(np.percentile(electrons, 100.0 - BRIGHTEST_PERCENT)),
            mean_dn=float(frame.mean()),
            highest_dn=int(frame.max()),
            saturated_percent=100.0 * float(np.mean((electrons >= full) | (frame >= camera.white_level_dn))),
            snr=float((mean - camera.black_level_dn).item() / np.sqrt(max(variance.item(), 1e-12))),
        ),
        versions=installed_versions(),
    )


def camera_sha256(content: CameraFile) -> str:
    """SHA-256 of the camera model, which includes a traced lens's hash, and of its effects."""
    parts = [
        content.camera.model_dump_json(),
        *(f"{effect.name} {effect.model_dump_json()}" for effect in content.effects),
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def check_out(file: Path) -> None:
    """Refuse a file that can't be written, before the work. Raises InputError."""
    writer_of(file)
    if file.is_dir():
        raise InputError(f"{file}: is a folder; name a file in it")
    with replacing(file.with_name(f"{file.name}.probe")) as partial:
        partial.touch()
    file.with_name(f"{file.name}.probe").unlink()


def write(simulation: Simulation, file: Path) -> SimulationRecord:
    """Write the frame to `file`, the preview to NAME.preview.png and the record to NAME.json beside it; returns the
    record."""
    record = simulation.record.model_copy(update={"file": file.name})
    metadata = RawMetadata(
        exposure_s=record.summary.exposure_s,
        gain_db=record.options.gain_db,
        camera_name=record.camera_name,
        software=f"calibench {record.versions.get('calibench', '')}".strip(),
        neutral=neutral(simulation.camera, simulation.white),
    )
    write_raw(file, simulation.frame, simulation.camera, metadata)
    _, data = cv2.imencode(".png", preview(simulation.frame, simulation.camera, simulation.white)[..., ::-1])
    with replacing(preview_file(file)) as partial:
        partial.write_bytes(data.tobytes())
    with replacing(record_file(file)) as partial:
        partial.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return record


def preview_file(file: Path) -> Path:
    """NAME.preview.png beside the frame."""
    return file.with_name(f"{file.stem}.preview.png")


def record_file(file: Path) -> Path:
    """NAME.json beside the frame."""
    return file.with_name(f"{file.stem}.json")


def neutral(camera: CameraModel, white: Spectrum) -> dict[str, float] | None:
    """Relative signal of a white surface in the scene's light, by channel; None for a MONO camera, and where a channel
    gets no signal."""
    if camera.cfa == "MONO":
        return None
    codes = {channel: electrons_of(white, camera.quantum_efficiency[channel]) for channel in "RGB"}
    return codes if min(codes.values()) > 0 else None


def preview(frame: Frame, camera: CameraModel, white: Spectrum) -> NDArray[np.uint8]:
    """Return a preview (rows, cols, 3: R, G, B), demosaicked, white-balanced on the scene's white, in sRGB. White is a
    full pixel."""
    gain = camera.conversion_gain_dn_per_e
    span = min(camera.full_well_e * gain, camera.white_level_dn - camera.black_level_dn)
    if camera.cfa == "MONO":
        linear = np.repeat(((frame - camera.black_level_dn) / span)[..., None], 3, axis=2)
    else:
        linear = (_demosaic(frame, camera) - camera.black_level_dn) / span
        balance = neutral(camera, white)
        if balance is not None:
            top = max(balance.values())
            linear = np.minimum(linear, 1.0) * np.array([top / balance[channel] for channel in "RGB"])
        linear = np.minimum(linear, 1.0) @ _to_srgb(camera).T
    linear = np.clip(linear, 0.0, 1.0)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.asarray(np.rint(255.0 * shown), np.uint8)


def _demosaic(frame: Frame, camera: CameraModel) -> FloatArray:
    if min(frame.shape) < 4:
        return np.repeat(frame[..., None].astype(float), 3, axis=2)
    # OpenCV names a mosaic by the second row's second and third pixel.
    code = {
        "RGGB": cv2.COLOR_BayerBG2RGB,
        "BGGR": cv2.COLOR_BayerRG2RGB,
        "GRBG": cv2.COLOR_BayerGB2RGB,
        "GBRG": cv2.COLOR_BayerGR2RGB,
    }[camera.cfa]
    return cv2.cvtColor(frame, code).astype(float)


def _to_srgb(camera: CameraModel) -> FloatArray:
    """Return the matrix (3, 3) from balanced camera colours to linear sRGB. White stays white."""
    from_srgb = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    daylight_codes = np.array([electrons_of(daylight(), camera.quantum_efficiency[channel]) for channel in "RGB"])
    balanced = np.diag(1.0 / daylight_codes) @ colour_matrix(camera) @ from_srgb
    balanced = balanced / balanced.sum(axis=1, keepdims=True)
    return np.asarray(np.linalg.inv(balanced))


def _line(error: Exception) -> str:
    """Return the message of an exception of `sim`, as one line."""
    if isinstance(error, ValidationError):
        problem = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in problem["loc"])
        return f"{where}: {problem['msg'].removeprefix('Value error, ')}".removeprefix(": ")
    return " ".join(str(error).split())


def options_of(values: Mapping[str, Any]) -> SimulateOptions:
    """Options from their values. Raises InputError in one line for a value outside its declaration."""
    try:
        return SimulateOptions.model_validate(values)
    except ValidationError as error:
        raise InputError(_line(error)) from error


def parameters_of(given: Sequence[str]) -> dict[str, float]:
    """Return the scene's parameters from KEY=VALUE pairs. Raises InputError for anything else."""
    read = {}
    for pair in given:
        key, equals, value = pair.partition("=")
        try:
            read[key.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--set {pair}: isn't KEY=VALUE with a number; write it as in --set contrast=0.4")
    return read


def summary_lines(record: SimulationRecord, file: Path) -> list[str]:
    """Return the lines that `calibench simulate` prints."""
    s, camera = record.summary, record.camera
    how = (
        f"brightest {BRIGHTEST_PERCENT:g} % at {100 * AUTO_SHARE:g} % of a full pixel"
        if s.automatic_exposure
        else "as asked"
    )
    noise = "expected, without noise" if record.options.expected else f"seed {record.options.seed}"
    return [
        (
            f"{file}: {camera['cols']} x {camera['rows']} {camera['cfa']}, {record.options.scene} under "
            f"{record.options.illuminant}, {noise}"
        ),
        (
            f"exposure {s.exposure_s:.4g} s ({how}); mean {s.mean_electrons:.4g} e, brightest {BRIGHTEST_PERCENT:g} % "
            f"{s.brightest_percent_electrons:.4g} e; "
            f"mean {s.mean_dn:.4g} DN, highest {s.highest_dn} DN; saturated {s.saturated_percent:.2g} %; SNR "
            f"{s.snr:.3g} at the mean"
        ),
        f"preview {preview_file(file).name}, record {record_file(file).name}",
    ]
