"""What a user of Python calls: one function for each job, which takes and returns the frozen result types.

`import calibench` re-exports these functions. Each is one call of the verb that the command line and the service call,
too; a function is here where that verb takes more than a notebook wants to say. Results show themselves: summary,
table and chart (`lab.report.notebook`).
"""

from __future__ import annotations

import contextlib
import getpass
import importlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from lab.engine import DEFAULT_ENGINE, Engine
from lab.errors import InputError, NotDetermined
from lab.progress_bar import progress_bar
from lab.shown import Presenter, present_with

if TYPE_CHECKING:
    from pydantic import BaseModel

    from lab.calibration.life import CalibrationRecord
    from lab.calibration.limits import CalibrationLimits
    from lab.capture.plan_devices import PlanDevices
    from lab.formats.camera_file import CameraFile
    from lab.formats.recording_set import RecordingSet
    from lab.formats.results import ComparisonResult, DiagnosisResult, FitResult, ValidationResult
    from lab.pipeline import Goal, PipelineRequest, PipelineResult
    from lab.predict.simulate import Simulation
    from lab.report.certificate import Certificate
    from lab.twin.score import TwinScore
    from lab.twin.sealed import SealedPrediction
    from sim.camera import Side


def _presenter() -> Presenter:
    return cast(Presenter, importlib.import_module("lab.report.notebook"))


present_with(_presenter)


def open_recordings(
    path: str | Path, kind: str | None = None, *, data: str | Path | None = None, **stated: Any
) -> RecordingSet:
    """Open recordings: a recording set, a folder of raw files, or a stored session.

    path : the folder, or a URL (`s3://bucket/set`); or, where there is none of that name, the id of a session in the
        data folder
    kind : the format of a folder that is no recording set: `raw-folder` (frames with an `index.csv`), `fits`,
        `emva1288`, `slanted-edge`, `colorchecker`, `dot-grid`, `checkerboard`. None: `raw-folder` where there is an
        `index.csv`, else `fits` where there are FITS files
    data : the data folder of sessions; None: what CALIBENCH_DATA says, else `calibench-data`
    stated : what such a format doesn't hold: `camera` (file), `exposure_s`, `checkerboard` and `dots` (rows, columns),
        `square_mm`, `channel`, `transfer`, `corners`, `light`, `white_patch`, `tap`, `only`, `ignore`

    Returns the recording set; its frames are decoded when they are asked for, its `warnings` say what was assumed.
    Raises InputError, a line for each problem.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> recordings.sides
    ('left',)
    >>> recordings.frame(recordings.captures("flat")[0]).shape
    (240, 320)
    """
    from lab.capture.data_folder import existing_store
    from lab.foreign_recordings import importers, read_foreign
    from lab.formats.importers.single_picture import ImportOptions
    from lab.formats.recording_set import RecordingError, inspect
    from lab.pipeline import source_recordings

    place = Path(path)
    kind = _kind_of(place) if kind is None else kind
    if kind is None:
        if stated:
            raise InputError(f"{path}: takes none of {', '.join(stated)}; state kind, one of {', '.join(importers())}")
        return source_recordings(str(path), lambda: existing_store(None if data is None else Path(data)))
    try:
        options = ImportOptions(**_as_paths(stated))
    except TypeError as error:
        raise InputError(f"{path}: {error}; `help(calibench.open_recordings)` lists what may be stated") from error
    recordings = read_foreign(kind, place, options)
    problems, warnings = inspect(recordings)
    if problems:
        raise RecordingError(problems)
    recordings.warnings = tuple(dict.fromkeys((*recordings.warnings, *warnings)))
    return recordings


def _kind_of(place: Path) -> str | None:
    """Return the importer for a folder; None where it is a recording set, or none can be told."""
    if not place.is_dir() or (place / "manifest.json").is_file():
        return None
    if (place / "index.csv").is_file():
        return "raw-folder"
    return "fits" if any(place.glob("*.fit*")) else None


def _as_paths(stated: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: Path(value) if name in ("camera", "light", "white_patch") and isinstance(value, str) else value
        for name, value in stated.items()
    }


def _opened(recordings: RecordingSet | str | Path) -> RecordingSet:
    return open_recordings(recordings) if isinstance(recordings, str | Path) else recordings


def _run(request: PipelineRequest, progress: bool | None) -> PipelineResult:
    from lab.pipeline import run_pipeline

    with progress_bar(progress) as advance:
        return run_pipeline(request, lambda now: advance(f"{now.step}: {now.what}".rstrip(": "), now.share))


def fit(recordings: RecordingSet | str | Path, *, progress: bool | None = None) -> FitResult:
    """Calibrate: noise, spectral sensitivity, MTF, PSF, geometry, stereo.

    recordings : a recording set, or what `open_recordings` opens
    progress : show a bar; None: on a terminal and in a notebook

    Returns the figures of each camera with their standard deviations; `skipped` says what the recordings don't
    determine. Raises InputError.

    >>> import calibench
    >>> fit = calibench.fit("my-camera")
    >>> noise = fit.cameras["left"].noise
    >>> abs(noise.conversion_gain_dn_per_e - 0.38) < 4 * noise.conversion_gain_dn_per_e_std
    True
    """
    from lab.pipeline import PipelineRequest

    found = _run(PipelineRequest("fit", recordings=_opened(recordings)), progress).fit
    assert found is not None
    return found


def validate(
    recordings: RecordingSet | str | Path,
    fit: FitResult | None = None,
    *,
    cameras: Mapping[Side, CameraFile] | None = None,
    progress: bool | None = None,
) -> ValidationResult:
    """Predict what the fit didn't use, and compare it with what was recorded.

    recordings : a recording set, or what `open_recordings` opens
    fit : the recordings' fit; None: it is made
    cameras : camera models by side, in place of the fitted ones
    progress : show a bar; None: on a terminal and in a notebook

    Returns a check for each chart, MTF and PSF: chi2 of n numbers, and whether it is within its 99.9 % quantile.
    Raises InputError.

    >>> import calibench
    >>> calibench.validate("my-camera").checks[0].name
    'mtf'
    """
    from lab.pipeline import PipelineRequest

    request = PipelineRequest("validate", recordings=_opened(recordings), fit=fit, models=cameras or {})
    found = _run(request, progress).validation
    assert found is not None
    return found


def diagnose(
    recordings: RecordingSet | str | Path,
    fit: FitResult | None = None,
    *,
    cameras: Mapping[Side, CameraFile] | None = None,
    engine: Engine = DEFAULT_ENGINE,
    progress: bool | None = None,
) -> DiagnosisResult:
    """Find the physics that the camera model leaves out.

    recordings : a recording set, or what `open_recordings` opens
    fit : the recordings' fit; None: it is made
    cameras : camera models by side to begin with, in place of the fitted ones
    engine : `evidence`, one table of sets of effects with their posterior probabilities; `today`, the engine before it
    progress : show a bar; None: on a terminal and in a notebook

    Returns the verdict, the effects with their probabilities and parameters, and how much better held-out captures are
    predicted; a family, as `line_noise`, where several of its effects explain the recordings as well. `evaluate`
    returns the improved cameras, too. Raises InputError.

    >>> import calibench
    >>> diagnosis = calibench.diagnose("my-camera")
    >>> sorted(effect.name for effect in diagnosis.effects)
    ['column_noise', 'line_noise']
    """
    from lab.pipeline import PipelineRequest

    request = PipelineRequest("diagnose", recordings=_opened(recordings), fit=fit, models=cameras or {}, engine=engine)
    found = _run(request, progress).diagnosis
    assert found is not None
    return found


def evaluate(
    recordings: RecordingSet | str | Path,
    goal: Literal["fit", "validate", "diagnose", "report"] = "report",
    *,
    report: str | Path | None = None,
    fit: FitResult | None = None,
    cameras: Mapping[Side, CameraFile] | None = None,
    engine: Engine = DEFAULT_ENGINE,
    progress: bool | None = None,
) -> PipelineResult:
    """Fit, validate, diagnose and write the report, or the part of these that leads to `goal`.

    recordings : a recording set, or what `open_recordings` opens
    goal : the last result that is wanted
    report : the page to write, HTML; needed for the goal `report`
    fit : the recordings' fit; None: it is made
    cameras : camera models by side, in place of the fitted ones
    engine : as of `diagnose`
    progress : show a bar; None: on a terminal and in a notebook

    Returns `fit`, `validation`, `diagnosis`, `improved` (the cameras with the effects that were found, by side) and
    `report` (the page's path). Raises InputError.

    >>> import calibench
    >>> found = calibench.evaluate("my-camera", "fit")
    >>> found.fit is not None and found.diagnosis is None
    True
    """
    from lab.pipeline import PipelineRequest

    if (goal == "report") is (report is None):
        raise InputError(f"evaluate: goal {goal} {'needs' if report is None else 'takes no'} report, the page to write")
    file = None if report is None else Path(report)
    request = PipelineRequest(
        cast("Goal", goal), recordings=_opened(recordings), fit=fit, models=cameras or {}, report_file=file,
        engine=engine,
    )  # fmt: skip
    return _run(request, progress)


def fitted_cameras(recordings: RecordingSet | str | Path, fit: FitResult) -> dict[Side, CameraFile]:
    """Return the camera models of a fit, for `simulate`, `predict` and `write_camera`.

    recordings : the recordings of the fit: the data sheet's values stand where nothing was fitted
    fit : the fit

    Returns a model by side; one that the figures make none of is left out.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> camera = calibench.fitted_cameras(recordings, calibench.fit(recordings))["left"].camera
    >>> camera.rows, camera.cols
    (240, 320)
    """
    from lab.formats.camera_file import fitted_camera

    opened = _opened(recordings)
    cameras: dict[Side, CameraFile] = {}
    for side, fitted in fit.cameras.items():
        with contextlib.suppress(InputError, NotDetermined):
            cameras[side] = fitted_camera(opened, side, fitted)
    return cameras


def read_camera(file: str | Path) -> CameraFile:
    """Read a camera file.

    file : TOML, as `write_camera` or `calibench fit --write-cameras` writes it

    Returns the camera model with its effects. Raises InputError, with the key that can't be used.

    >>> import calibench
    >>> calibench.read_camera(calibench.write_camera(calibench.default_camera(), "camera.toml")).camera.cols
    1280
    """
    from lab.formats.camera_file import read_camera as read

    return read(Path(file))


def write_camera(camera: CameraFile, file: str | Path) -> Path:
    """Write a camera file that `read_camera` reads back to exactly the same camera.

    camera : as of `fitted_cameras`, `default_camera` or `evaluate(...).improved`
    file : the file, TOML

    Returns the file. Raises InputError where it can't be written.

    >>> import calibench
    >>> calibench.write_camera(calibench.default_camera(), "camera.toml").name
    'camera.toml'
    """
    from lab.formats.camera_file import write_camera as write

    write(Path(file), camera)
    return Path(file)


def predict(
    cameras: Mapping[Side, CameraFile],
    plan: RecordingSet | str | Path,
    change: Mapping[str, Any] | None = None,
    *,
    fitted: RecordingSet | str | Path | None = None,
) -> SealedPrediction:
    """Predict the measured numbers of a session before it is captured, with their standard deviations.

    cameras : camera models by side, as of `fitted_cameras` or of `evaluate(...).improved`
    plan : recordings whose captures are planned again; flats state their radiance or photons, edges their region and
        angle
    change : what differs: `f_number`, `temperature_c`, `lamp`, `lens`, `distance_mm`, `exposure_factor`, `gain_db`,
        `radiance_factor`
    fitted : the recordings of the fit; levels of flats are predicted relative to theirs, which needs their photon
        numbers or radiance

    Returns the prediction; `seal` writes it with its hash, `score` compares it with the session. Raises InputError.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> cameras = calibench.fitted_cameras(recordings, calibench.fit(recordings))
    >>> darks = recordings.without({one.id for one in recordings.captures() if one.kind != "dark"})
    >>> prediction = calibench.predict(cameras, darks, {"exposure_factor": 0.5})
    >>> {number.quantity for number in prediction.sides["left"].numbers}
    {'dark'}
    """
    from lab.twin.changes import validate_changes
    from lab.twin.predict import predict as predicted

    return predicted(
        cameras,
        _opened(plan),
        validate_changes(change or {}, "change "),
        model=", ".join(one.name for one in cameras.values()),
        fitted=None if fitted is None else _opened(fitted),
    )


def seal(prediction: SealedPrediction, file: str | Path) -> str:
    """Write a prediction, and its SHA-256 beside it, before the session is captured.

    prediction : as of `predict`
    file : the sealed prediction, JSON; FILE.sha256 gets the hash

    Returns the hash (hexadecimal). Raises InputError where the files can't be written.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> cameras = calibench.fitted_cameras(recordings, calibench.fit(recordings))
    >>> darks = recordings.without({one.id for one in recordings.captures() if one.kind != "dark"})
    >>> hashed = calibench.seal(calibench.predict(cameras, darks), "sealed.json")
    >>> calibench.open_seal("sealed.json", hashed).plan
    'my-camera'
    """
    from lab.twin.sealed import seal as sealed

    return sealed(prediction, Path(file))


def open_seal(file: str | Path, sha256: str | None = None) -> SealedPrediction:
    """Read a sealed prediction, and compare it with its hash.

    file : as of `seal`
    sha256 : the hash; None: that of FILE.sha256

    Returns the prediction. Raises InputError where the file isn't the one that was sealed.

    >>> import calibench
    >>> calibench.open_seal("nothing.json")
    Traceback (most recent call last):
        ...
    lab.errors.InputError: nothing.json: it or its hash nothing.json.sha256 can't be read; give both files
    """
    from lab.twin.sealed import open_seal as opened

    return opened(Path(file), sha256)


def score(prediction: SealedPrediction, recordings: RecordingSet | str | Path) -> TwinScore:
    """Compare a prediction with the session that it is of.

    prediction : as of `predict`, or read by `open_seal`
    recordings : the session: a recording set, or what `open_recordings` opens

    Returns chi2, and each number with its deviation. Raises InputError where the session isn't the predicted one.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> cameras = calibench.fitted_cameras(recordings, calibench.fit(recordings))
    >>> darks = recordings.without({one.id for one in recordings.captures() if one.kind != "dark"})
    >>> found = calibench.score(calibench.predict(cameras, darks), darks)
    >>> found.n == len(found.numbers)
    True
    """
    from lab.twin.score import score as scored

    return scored(prediction, _opened(recordings))


def simulate(
    scene: str,
    camera: CameraFile | str | Path | None = None,
    *,
    lens: str | Path | None = None,
    progress: bool | None = None,
    **options: Any,
) -> Simulation:
    """Simulate one raw frame.

    scene : a scene's name (`uniform`, `slanted-edge`, `colorchecker24`, ...), a picture or a spectral cube
    camera : a camera model or its file; None: a typical RGB camera, as of `default_camera`
    lens : a prescription (.zmx) to put before it
    progress : show a bar; None: on a terminal and in a notebook
    options : of `SimulateOptions`: `exposure_s` (None: automatic), `gain_db`, `temperature_c`, `illuminant`,
        `luminance_cd_m2`, `distance_mm`, `parameters` of the scene, `seed` of the noise, `pattern_seed` of the fixed
        pattern, `expected` (leave the noise out)

    Returns the frame (rows, cols), uint16 in DN, and its record; `write_frame` writes them. Raises InputError.

    >>> import calibench
    >>> calibench.simulate("uniform", exposure_s=0.01, seed=1).frame.shape
    (960, 1280)
    """
    from lab.formats.camera_file import CameraFile
    from lab.predict import simulate as simulation

    with progress_bar(progress) as advance:
        if not isinstance(camera, CameraFile):
            content = simulation.camera_for(
                None if camera is None else Path(camera), None if lens is None else Path(lens), progress=advance
            )
        else:
            content = camera if lens is None else simulation.with_lens(camera, Path(lens), progress=advance)
        return simulation.simulate(simulation.options_of({"scene": scene} | options), content, advance)


def write_frame(simulation: Simulation, file: str | Path) -> Path:
    """Write a simulated frame, with a preview (NAME.preview.png) and its record (NAME.json) beside it.

    simulation : as of `simulate`
    file : ends in `.npy`, `.tif` or `.dng`

    Returns the file. Raises InputError.

    >>> import calibench
    >>> calibench.write_frame(calibench.simulate("slanted-edge", seed=1), "edge.dng").name
    'edge.dng'
    """
    from lab.predict.simulate import check_out, write

    path = Path(file)
    check_out(path)
    write(simulation, path)
    return path


def compare(a: FitResult | RecordingSet | str | Path, b: FitResult | RecordingSet | str | Path) -> ComparisonResult:
    """Compare two calibrations: which figures changed beyond their uncertainty.

    a, b : fits, files of fits (JSON), or recordings, which are fitted

    Returns every figure of both, the difference and its significance. Raises InputError.

    >>> import calibench
    >>> fit = calibench.fit("my-camera")
    >>> calibench.compare(fit, fit).changed
    False
    """
    from lab.fit.compare import compare as compared
    from lab.formats.recording_set import differences

    (before, then), (after, now) = _calibration(a), _calibration(b)
    return compared(before, after).model_copy(update={"instruments": differences(then, now)})


def _calibration(source: FitResult | RecordingSet | str | Path) -> tuple[FitResult, Mapping[str, Any]]:
    """Return a fit, and what the instruments said of themselves, where that is known."""
    from lab.formats.result_file import read_result as read
    from lab.formats.results import FitResult

    if isinstance(source, FitResult):
        return source, {}
    if isinstance(source, str | Path) and Path(source).is_file():
        return read(FitResult, Path(source)), {}
    recordings = _opened(source)
    return fit(recordings), recordings.manifest.instruments


def read_result(file: str | Path) -> BaseModel:
    """Read a result that `write_result`, or a command's `--json`, wrote.

    file : JSON with a key `format`

    Returns the result in its own type. Raises InputError where the file isn't a result.

    >>> import calibench
    >>> fit = calibench.fit("my-camera")
    >>> calibench.read_result(calibench.write_result(fit, "fit.json")) == fit
    True
    """
    import json

    from lab.formats import result_file

    path = Path(file)
    try:
        format = json.loads(path.read_text(encoding="utf-8")).get("format")
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: can't be read as a result ({error}); give the file that --json wrote") from error
    known = {str(model.model_fields["format"].default): model for model in _result_models()}
    if format not in known:
        raise InputError(f"{path}: its format is {format!r}, none that is read; give one of {', '.join(known)}")
    return result_file.read_result(known[format], path)


def _result_models() -> tuple[type[BaseModel], ...]:
    from lab.formats.results import ComparisonResult, DiagnosisResult, FitResult, ValidationResult
    from lab.twin.score import TwinScore
    from lab.twin.sealed import SealedPrediction

    return FitResult, ValidationResult, DiagnosisResult, ComparisonResult, SealedPrediction, TwinScore


def write_result(result: BaseModel, file: str | Path) -> Path:
    """Write a result as JSON, completely or not at all.

    result : a fit, a validation, a diagnosis, a comparison, a prediction or its score
    file : the file

    Returns the file. Raises InputError where it can't be written.

    >>> import calibench
    >>> calibench.write_result(calibench.fit("my-camera"), "fit.json").name
    'fit.json'
    """
    from lab.formats import result_file

    result_file.write_result(result, Path(file))
    return Path(file)


def write_report(
    recordings: RecordingSet | str | Path,
    file: str | Path,
    fit: FitResult,
    validation: ValidationResult | None = None,
    diagnosis: DiagnosisResult | None = None,
    *,
    improved: Mapping[Side, CameraFile] | None = None,
) -> Path:
    """Write the report of results as one page that needs nothing else, data sheets after EMVA 1288 among it.

    recordings : a recording set, or what `open_recordings` opens
    file : the page, HTML
    fit : the recordings' fit
    validation, diagnosis : the other results; None: the page says that they were not made
    improved : the cameras with the effects that the diagnosis found, by side (`evaluate(...).improved`)

    Returns the page's path. `evaluate(recordings, report=file)` makes the results, too. Raises InputError.

    >>> import calibench
    >>> recordings = calibench.open_recordings("my-camera")
    >>> calibench.write_report(recordings, "report.html", calibench.fit(recordings)).name
    'report.html'
    """
    from lab.predict.validate import predict_both
    from lab.report import write_report as written

    opened = _opened(recordings)
    both = predict_both(opened, fit, improved or {}, diagnosis)
    return written(file, opened, fit, validation, diagnosis, both=both)


def certify(
    session: str,
    limits: CalibrationLimits | str | Path | None = None,
    *,
    by: str = "",
    accept_warnings: bool = False,
    data: str | Path | None = None,
) -> CalibrationRecord:
    """Certify a stored session's calibration against limits; an earlier one of the same cameras is replaced.

    session : the session's id: its newest calibration; or a calibration's id
    limits : the limits, or their file (TOML); None: `limits.toml` in the data folder
    by : who certifies; empty: this computer's user
    accept_warnings : certify with figures in the warning band
    data : the data folder; None: what CALIBENCH_DATA says, else `calibench-data`

    Returns the calibration. Raises InputError, a line for each figure that is bad or missing.

    >>> import calibench
    >>> calibench.certify("20300101-101500-7f3ad2", data="nowhere")
    Traceback (most recent call last):
        ...
    lab.errors.InputError: nowhere: holds no registry; name the data folder by --data, or, where its registry is \
a database server's, set CALIBENCH_DATABASE_URL as the service has it
    """
    from lab.calibration import life
    from lab.calibration.limits import read_limits
    from lab.capture.data_folder import store_to_read

    with contextlib.closing(store_to_read(None if data is None else Path(data))) as store:
        if limits is None or isinstance(limits, str | Path):
            limits = read_limits(store.root / "limits.toml" if limits is None else Path(limits))
        return life.certify(store, session, by or getpass.getuser(), limits, accept_warnings=accept_warnings)


def write_certificate(session: str, file: str | Path, *, data: str | Path | None = None) -> Certificate:
    """Write the certificate of a certified calibration as a page to print.

    session : the session's id, or the calibration's
    file : the page, HTML
    data : the data folder; None: what CALIBENCH_DATA says, else `calibench-data`

    Returns what the page states, with its hashes (SHA-256). Raises InputError where the calibration isn't certified.

    >>> import calibench
    >>> calibench.write_certificate("20300101-101500-7f3ad2", "certificate.html", data="nowhere")
    Traceback (most recent call last):
        ...
    lab.errors.InputError: nowhere: holds no registry; name the data folder by --data, or, where its registry is \
a database server's, set CALIBENCH_DATABASE_URL as the service has it
    """
    from lab.calibration import life
    from lab.capture.data_folder import store_to_read
    from lab.report.certificate import write_certificate as write

    with contextlib.closing(store_to_read(None if data is None else Path(data))) as store:
        return write(store, life.calibration(store, session), Path(file))


@contextlib.contextmanager
def mock_bench(*conceal: str) -> Iterator[Path]:
    """Start the mock bench in a process of its own, for the block.

    conceal : what it conceals, `SIDE:EFFECT:PARAMETER=VALUE` each; none: a nominal bench

    Yields its station file. Raises InputError where the bench refuses an effect, DeviceError where it doesn't start.

    >>> import calibench
    >>> with calibench.mock_bench() as station:
    ...     station.name
    'station.toml'
    """
    from lab.bench_process import mock_bench as started

    with started(conceal, () if conceal else ("--healthy",)) as station:
        yield station


def bench_devices(station: str | Path, folder: str | Path) -> AbstractContextManager[PlanDevices]:
    """Connect to a station's instruments as bluesky devices, for plans of your own.

    station : the station file, TOML
    folder : where frames (`frames/NUMBER-SIDE.npy`) and spectra (`spectra/NUMBER.csv`) are written

    Returns a context manager that yields the devices: `cameras`, `light`, `shutter`, `screen`, `radiometer`,
    `photodiode`, `target` (None for an instrument that isn't there); it brings all into their safe state at its end.
    Raises DeviceError where an instrument doesn't answer.

    >>> import calibench
    >>> with calibench.mock_bench() as station, calibench.bench_devices(station, "mine") as bench:
    ...     sorted(bench.cameras.cameras)
    ['left', 'right']
    """
    from lab.capture.plan_devices import plan_devices
    from lab.capture.station import read_station

    return plan_devices(read_station(Path(station)), Path(folder))
