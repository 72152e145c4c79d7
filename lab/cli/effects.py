"""`calibench effects`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from lab.cli.console import check_writable, out, write_json
from lab.cli.sources import Json

if TYPE_CHECKING:
    from lab.diagnose.effect_list import EffectDescription

commands = typer.Typer()


@commands.command()
def effects(
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="only this effect")] = "",
    json: Json = None,
) -> None:
    """The library of effects: its families, where each effect acts, its parameters, which measurements can show it, and
    its rivals."""
    from lab.diagnose.effect_list import EffectList, effect_description, effect_list

    check_writable(json)
    told = EffectList(effects=(effect_description(name),)) if name else effect_list()
    write_json(told, json)
    if str(json) != "-":
        for family in told.families:
            out.print(f"[bold]{escape(family.name)}[/]: {escape(family.sentence)} {escape(', '.join(family.members))}")
        if told.families:
            out.print()
        for number, effect in enumerate(told.effects):
            if number:
                out.print()
            _print_effect(effect)


def _print_effect(effect: EffectDescription) -> None:
    out.print(f"[bold]{escape(effect.name)}[/] ({', '.join(effect.stages)}): {escape(effect.sentence)}")
    if effect.remark is not None:
        out.print(f"  [yellow]{escape(effect.remark)}[/]")
    if effect.parameters:
        table = Table(box=None, pad_edge=False)
        for heading in ("  parameter", "unit", "from", "to", "usual", "absent", "what it is"):
            table.add_column(heading)
        for one in effect.parameters:
            usual = "any" if one.prior is None else "{:g} ± {:g}".format(*one.prior)
            numbers = ("-" if value is None else f"{value:g}" for value in (one.lower, one.upper))
            absent = "-" if one.absent is None else f"{one.absent:g}"
            table.add_row(f"  {one.name}", one.unit, *numbers, usual, absent, escape(one.meaning))
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
