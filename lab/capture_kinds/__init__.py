"""The kinds of capture: one file each, with all that the rest of `lab` and `api` needs of the kind.

The list below is the only one. A new kind is a file here and a line in that list: see
`docs/how-to/add-a-capture-kind.md`.
"""

from importlib import import_module

from lab.capture_kinds.base import register

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
)
for _file in FILES:
    register(import_module(f"{__name__}.{_file}").KIND)
