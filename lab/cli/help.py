"""Help texts of the command line: whole first sentences in lists of commands, and units in place of Python's types."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

#: What a value is called by the end of its option's name; options of other ends by their type.
UNITS = {"s": "S", "mm": "MM", "nm": "NM", "deg": "DEG", "db": "DB", "c": "C", "cd-m2": "CD_M2", "percent": "PERCENT"}
TYPES = {str: "NAME", int: "N", float: "NUMBER", Path: "FILE"}
#: The paragraph of a docstring that shows a command line.
EXAMPLE = re.compile(r"\n\s*\n\s*Example: ")
#: What stands before it in a help: a new paragraph that isn't wrapped.
UNWRAPPED_EXAMPLE = "\n\n\b\nExample: "


def complete_help(command: Any) -> Any:
    """Complete the help of a click command and of all commands below it, in place; return the command.

    A summary in a list of commands is the whole first sentence. The value of an option without a metavar is named by
    the unit at the end of the option's name, else by its kind. An argument's name stands without a type.
    """
    if command.help:
        command.short_help = first_sentence(command.help)
        command.help = EXAMPLE.sub(UNWRAPPED_EXAMPLE, command.help)
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            parameter.display_type_rich = lambda ctx: ""
        elif parameter.metavar is None and "<" in (parameter.display_type_rich(ctx=None) or ""):
            parameter.metavar = value_name(parameter.opts[0], parameter.type_descriptor.annotation)
    for below in getattr(command, "commands", {}).values():
        complete_help(below)
    return command


def help_and_example(command: Any) -> tuple[str, str]:
    """Return what a completed command's help says, and the command line that it shows ("": none)."""
    text, _, example = (command.help or "").partition(UNWRAPPED_EXAMPLE)
    return text.rstrip(), example.rstrip()


def first_sentence(text: str) -> str:
    """Return the first sentence of a text, on one line.

    >>> first_sentence("List the sessions. With a name:\\nthose of it.")
    'List the sessions.'
    """
    return re.split(r"(?<=\.)\s", " ".join(text.split()))[0]


def value_name(option: str, kind: Any) -> str:
    """Return what the value of an option is called.

    >>> value_name("--exposure-s", float), value_name("--seed", int)
    ('S', 'N')
    """
    words = option.lstrip("-")
    unit = next((name for end, name in UNITS.items() if words.endswith(f"-{end}")), None)
    return unit or TYPES.get(kind, "NAME")
