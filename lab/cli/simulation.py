"""`calibench simulate` and `calibench lens`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import check_folder, check_writable, out, progress_bar, warn, write_json
from lab.cli.sources import Json, Scheduler
from lab.errors import InputError

if TYPE_CHECKING:
    from lab.predict.lens import LensResult

commands = typer.Typer()


@commands.command()
def lens(
    file: Annotated[Path, typer.Argument(metavar="FILE.zmx", help="a Zemax prescription")],
    json: Json = None,
    report_folder: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="write DIR/lens.html, one page with pictures")
    ] = None,
    focus: Annotated[
        str, typer.Option(help="the image where the file has it (file) or at best focus on axis (best)")
    ] = "file",
    field_deg: Annotated[
        float | None, typer.Option(help="the corner of the field (without: the file's largest)")
    ] = None,
    glass: Annotated[
        list[str] | None, typer.Option(metavar="NAME=OTHER", help="a glass for another: NAME=OTHER or NAME=nd,Vd")
    ] = None,
    scheduler: Scheduler = None,
) -> None:
    """Evaluate a lens prescription: first-order quantities, illumination, distortion, MTF, PSF.

    Example: calibench lens double-gauss.zmx --report lens
    """
    from lab.predict.lens import parse_glasses, trace_prescription
    from lab.workers import Workers

    check_writable(json)
    check_folder(report_folder)
    if focus not in ("file", "best"):
        raise InputError(f"--focus {focus}: give file or best")
    workers = Workers(scheduler=scheduler)
    workers.check()
    with progress_bar(file.name) as advance:
        traced = trace_prescription(
            file,
            focus="best" if focus == "best" else "file",
            maximum_field_deg=field_deg,
            glasses=parse_glasses(glass or []),
            progress=advance,
            workers=workers,
        )
    warn(traced.result.warnings)
    write_json(traced.result, json)
    if str(json) != "-":
        _print_lens(traced.result)
    if report_folder is not None:
        from lab.report.lens import write_lens_report

        out.print(f"report: {write_lens_report(report_folder, traced)}")


def _print_lens(result: LensResult) -> None:
    out.print(
        f"{escape(result.name)}: f = {result.focal_length_mm:.4f} mm, f/{result.f_number:.3f}, "
        f"entrance pupil {result.entrance_pupil_mm:.4f} mm at {result.primary_wavelength_nm:.1f} nm"
    )
    table = Table(box=None, pad_edge=False)
    for heading in ("field, deg", "height, mm", "relative illumination", "distortion, %", "in the window, %"):
        table.add_column(heading, justify="right")
    at = result.reference_wavelength_nm
    first = result.fields[0].mtf
    curve = next(i for i, psf in enumerate(first) if psf.wavelength_nm == at)
    frequencies = first[curve].frequency_lp_per_mm
    for frequency in frequencies:
        table.add_column(f"MTF S/T, {frequency:g} lp/mm", justify="right")
    for field in result.fields[::4] if len(result.fields) == 21 else result.fields:
        nearest = min(field.psf, key=lambda psf: abs(psf.wavelength_nm - at))
        mtf = field.mtf[curve]
        table.add_row(
            f"{field.angle_deg:.2f}",
            f"{field.height_mm:.4f}",
            f"{field.relative_illumination:.4f}",
            f"{field.distortion_percent:.3f}",
            f"{100 * nearest.encircled_share:.2f}",
            *(f"{s:.3f} / {t:.3f}" for s, t in zip(mtf.sagittal, mtf.tangential, strict=True)),
        )
    out.print(table)


@commands.command()
def simulate(
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE", help="a scene's name (`calibench simulate list` shows them), a picture or a cube"
        ),
    ] = "",
    out_file: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="the frame: .npy, .tif or .dng")
    ] = None,
    illuminant: Annotated[
        str, typer.Option(metavar="NAME or CSV", help="an illuminant (D65, A, FL2, ...) or a measured light")
    ] = "D65",
    luminance_cd_m2: Annotated[
        float | None, typer.Option(help="of a perfect white diffuser in that light (named lights: 100)")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="a camera file (TOML); without one, a typical RGB camera")
    ] = None,
    lens: Annotated[Path | None, typer.Option(metavar="FILE.zmx", help="put this lens before the camera")] = None,
    exposure_s: Annotated[
        float | None, typer.Option(help="exposure (without: the brightest 1 % at 70 % of what a pixel holds)")
    ] = None,
    gain_db: Annotated[float, typer.Option(help="analogue gain")] = 0.0,
    temperature_c: Annotated[float | None, typer.Option(help="temperature of the sensor")] = None,
    distance_mm: Annotated[float, typer.Option(help="distance of the scene from the lens")] = 1000.0,
    parameter: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="a parameter of the scene; may be repeated")
    ] = None,
    seed: Annotated[int, typer.Option(help="seed of the noise: the same gives the same frame")] = 0,
    pattern_seed: Annotated[int, typer.Option(help="seed of the fixed patterns: which camera of its kind")] = 0,
    expected: Annotated[bool, typer.Option("--expected", help="leave the noise out")] = False,
    cache: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="where lens tables are kept (CALIBENCH_CACHE, else the user's cache)"),
    ] = None,
    write_camera_file: Annotated[
        Path | None, typer.Option("--write-camera", metavar="FILE", help="write the camera as a file to start from")
    ] = None,
) -> None:
    """Simulate one raw frame, with a preview (NAME.preview.png) and a record (NAME.json) beside it.

    Example: calibench simulate slanted-edge --exposure-s 0.01 --out edge.dng
    """
    from lab.predict import simulate as simulation

    if scene == "list":
        _print_scenes()
        return
    if out_file is None and write_camera_file is None:
        raise InputError("simulate: no --out; name the frame's file, ending in .npy, .tif or .dng")
    if out_file is not None and not scene:
        raise InputError("simulate: no SCENE; `calibench simulate list` shows them")
    if out_file is not None:
        simulation.check_out(out_file)
    check_writable(write_camera_file)
    options = simulation.options_of(
        {
            "scene": scene,
            "parameters": simulation.parameters_of(parameter or []),
            "illuminant": illuminant,
            "luminance_cd_m2": luminance_cd_m2,
            "distance_mm": distance_mm,
            "exposure_s": exposure_s,
            "gain_db": gain_db,
            "temperature_c": temperature_c,
            "seed": seed,
            "pattern_seed": pattern_seed,
            "expected": expected,
        }
    )
    with progress_bar("simulate") as advance:
        content = simulation.camera_for(camera, lens, cache, advance)
        if write_camera_file is not None:
            from lab.formats.camera_file import write_camera

            write_camera(write_camera_file, content)
            out.print(f"camera: {escape(str(write_camera_file))}")
        if out_file is None:
            return
        made = simulation.simulate(options, content, advance)
        advance("files", 0.95)
        record = simulation.write(made, out_file)
    warn(record.lens_warnings)
    for line in simulation.summary_lines(record, out_file):
        out.print(escape(line))


def _print_scenes() -> None:
    from sim.scene.catalogue import scenes

    table = Table(box=None, pad_edge=False)
    for heading in ("scene", "what it shows", "parameters (--set KEY=VALUE)"):
        table.add_column(heading)
    for name, scene in scenes().items():
        keys = (f"{key}={scene.model_fields[key].default}" for key in scene.quantities())
        table.add_row(name, scene.shows, escape(" ".join(keys)))
    out.print(table)
