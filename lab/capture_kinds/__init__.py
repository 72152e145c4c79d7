"""The kinds of capture: one file each, with all that the rest of `lab` and `api` needs of the kind.

A new kind is a file here and a line in the list below (`docs/how-to/add-a-capture-kind.md`), or an entry point of the
group `calibench.capture_kinds` in another package.
"""

from importlib import import_module

from lab.capture_kinds.base import register
from sim.extensions import extensions, refuse

#: The files, in the order in which a full session takes the kinds.
FILES = (
    "dark",
    "flat",
    "narrowband",
    "chart",
    "slanted_edge",
    "stopped_edge",
    "white",
    "black",
    "checkerboard",
    "bernoulli",
    "charuco",
    "flare",
)
for _file in FILES:
    register(import_module(f"{__name__}.{_file}").KIND)
for _name, _kind in extensions("capture_kinds"):  # of other packages
    try:
        register(_kind)
    except Exception as error:  # whatever it is that isn't a kind of capture
        refuse("capture_kinds", _name, f"{_kind!r} can't be registered ({type(error).__name__}: {error})")
