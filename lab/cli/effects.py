"""`calibench effects`: the library, and drafts of new ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table
from typer.core import TyperGroup

from lab.cli.console import EXIT_CHECK, check_folder, check_writable, make_folder, out, warn, write_json
from lab.cli.sources import Json, StoreFolder, recordings_of, run_here
from lab.errors import InputError
from lab.pipeline import PipelineRequest

if TYPE_CHECKING:
    from lab.diagnose.visibility import EffectDescription


class _ListedByDefault(TyperGroup):
    """Commands of which `list` is meant where none is named: `calibench effects NAME`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put `list` before arguments that name no command."""
        if not args or args[0] not in {*self.commands, "--help"}:
            args = ["list", *args]
        return super().parse_args(ctx, args)


commands = typer.Typer(
    name="effects",
    cls=_ListedByDefault,
    help="The library of effects, and drafts of new ones from discovered laws. `calibench effects NAME` is "
    "`calibench effects list NAME`.",
)
#: `calibench check-effect` and `calibench check-chart`, which stand beside `calibench effects`.
check_command = typer.Typer()


@commands.command("list")
def list_effects(
    name: Annotated[str, typer.Argument(metavar="NAME", help="only this effect")] = "",
    json: Json = None,
) -> None:
    """The library of effects: its families, where each effect acts, its parameters, which measurements can show it, and
    its rivals.

    Example: calibench effects list optical_low_pass_filter
    """
    from lab.diagnose.visibility import EffectList, effect_description, effect_list
    from sim.extensions import refused

    check_writable(json)
    listed = EffectList(effects=(effect_description(name),)) if name else effect_list()
    write_json(listed, json)
    if str(json) != "-":
        warn(refused())
        for family in listed.families:
            out.print(f"[bold]{escape(family.name)}[/]: {escape(family.sentence)} {escape(', '.join(family.members))}")
        if listed.families:
            out.print()
        for number, effect in enumerate(listed.effects):
            if number:
                out.print()
            _print_effect(effect)


@commands.command()
def draft(
    source: Annotated[
        str,
        typer.Argument(metavar="SET", help="a recording set, a stored session, or the JSON file of a diagnosis"),
    ],
    law: Annotated[int, typer.Option("--law", metavar="N", help="which of the discovered laws, from 1 on")],
    out_file: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE or DIR",
            help="the effect's file, NAME.py, for a checkout; or the folder of an installable package, NAME",
        ),
    ],
    data: StoreFolder = None,
) -> None:
    """Write a law that a diagnosis discovered as a new effect's file with its test, or as a package that `pip install`
    takes. They pass the contract of effects as they stand; existing files are kept.

    Example: calibench effects draft diagnosis.json --law 1 --out code_step
    """
    from lab.diagnose.effect_draft import draft as drafted
    from lab.diagnose.effect_draft import place_of_test
    from lab.effect_packages import drafted_package, package_files
    from lab.formats.result_file import read_result
    from lab.formats.results import DiagnosisResult

    is_package = out_file.suffix != ".py"
    files = package_files(out_file) if is_package else (out_file, place_of_test(out_file))
    if is_package:
        check_folder(out_file)
    for file in files:
        if not is_package:
            check_writable(file)
        if file.exists():
            raise InputError(f"{file}: is there already; name another file, or remove it")
    if source.endswith(".json"):
        diagnosis: DiagnosisResult | None = read_result(DiagnosisResult, Path(source))
    else:
        request = PipelineRequest("diagnose", recordings=recordings_of(source, data), pictures=False)
        diagnosis = run_here(request).diagnosis
    assert diagnosis is not None
    laws = diagnosis.discovered
    if not 1 <= law <= len(laws):
        there = f"laws 1 to {len(laws)} were discovered" if laws else "no law was discovered"
        raise InputError(f"--law {law}: {there} in {source}; `calibench diagnose` tells them in their order")
    write = drafted_package if is_package else drafted
    texts = write(laws[law - 1], law, diagnosis.source, out_file)
    if is_package:
        make_folder(out_file)
    for file, text in zip(files, texts, strict=True):
        file.write_text(text, encoding="utf-8")
        out.print(f"{file}")
    out.print(escape(laws[law - 1].statement))


@check_command.command("check-effect")
def check_effect(
    package: Annotated[
        str, typer.Argument(metavar="PACKAGE", help="an installed package, or the name of an effect that one adds")
    ],
) -> None:
    """Run the contract of effects on those of an installed package. Exit code 4 where one doesn't keep it.

    Example: calibench check-effect calibench-effect-code-step
    """
    from lab.extension_checks import check_effects

    _tell_checked("effects", check_effects(package))


@check_command.command("check-chart")
def check_chart(
    package: Annotated[
        str, typer.Argument(metavar="PACKAGE", help="an installed package, or the name of a chart that one adds")
    ],
) -> None:
    """Run the contract of charts on those of an installed package. Exit code 4 where one doesn't keep it.

    Example: calibench check-chart calibench-chart-grey-scale
    """
    from lab.extension_checks import check_charts

    _tell_checked("charts", check_charts(package))


def _tell_checked(group: str, checked: Mapping[str, Sequence[str]]) -> None:
    for name, lines in checked.items():
        for line in lines:
            out.print(escape(f"{name}: {line}"))
        out.print(escape(f"{name}: {f'{len(lines)} complaints' if lines else f'keeps the contract of {group}'}"))
    if any(checked.values()):
        raise typer.Exit(EXIT_CHECK)


def _print_effect(effect: EffectDescription) -> None:
    out.print(f"[bold]{escape(effect.name)}[/] ({', '.join(effect.stages)}): {escape(effect.sentence)}")
    if effect.remark is not None:
        out.print(f"  [yellow]{escape(effect.remark)}[/]")
    if effect.parameters:
        table = Table(box=None, pad_edge=False)
        for heading in ("  parameter", "unit", "from", "to", "usual", "absent", "what it is"):
            table.add_column(heading)
        for parameter in effect.parameters:
            usual = "any" if parameter.prior is None else "{:g} ± {:g}".format(*parameter.prior)
            numbers = ("-" if value is None else f"{value:g}" for value in (parameter.lower, parameter.upper))
            absent = "-" if parameter.absent is None else f"{parameter.absent:g}"
            table.add_row(f"  {parameter.name}", parameter.unit, *numbers, usual, absent, escape(parameter.meaning))
        out.print(table)
    for choice in effect.choices:
        values = f" ({', '.join(choice.values)})" if choice.values else ""
        out.print(
            f"  {choice.name}, not fitted: {escape(choice.meaning)}{escape(values)}; {escape(choice.default)} if not "
            "given"
        )
    for heading, items in (
        ("family", (effect.family,)),
        ("measurements that can show it", effect.measurements),
        ("captures that these rest on", effect.capture_kinds),
        ("rivals", effect.rivals),
        ("doesn't depend on", effect.invariances),
        ("after", (effect.reference,)),
    ):
        out.print(f"  {heading}: {escape(', '.join(items)) or 'none'}")
