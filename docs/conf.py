"""The documentation as a site, by Sphinx: `make docs`. It is built from the pages that the repository shows, as they
are; what they don't hold, the order of the pages, is stated here (`CONTENTS`)."""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

project = "calibench"
author = "the authors of calibench"
version = release = metadata.version("calibench")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
include_patterns = ["README.md", "CONTRIBUTING.md", "docs/**"]
exclude_patterns = ["docs/notebooks/**", "docs/examples/**"]
root_doc = "README"
default_role = "literal"

html_theme = "furo"
html_title = "calibench"
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
html_math_renderer = "mathml"

autodoc_member_order = "groupwise"
autodoc_typehints_format = "short"
autodoc_default_options = {"exclude-members": "model_config"}
python_maximum_signature_line_length = 80
python_use_unqualified_type_names = True

#: The sections of the site: title, and pages (a pattern takes what no earlier line names).
CONTENTS = {
    "Learn": ["docs/tutorial"],
    "Do": ["docs/how-to/calibrate-my-camera", "docs/how-to/*", "docs/write-a-driver", "docs/test-a-driver"],
    "Look up": ["docs/reference/python", "docs/reference/*"],
    "Understand": [
        "docs/explanation/chain-of-light",
        "docs/explanation/accuracy",
        "docs/explanation/accuracy/*",
        "docs/explanation/*",
        "docs/explanation/examples/*",
        "docs/explanation/decisions/README",
        "docs/explanation/decisions/*",
    ],
    "Evidence": ["docs/proof*", "docs/real-recordings*"],
    "Work on it": ["CONTRIBUTING"],
}
#: A line of a docstring that says what an argument is.
ARGUMENT = re.compile(r"^(\s*)(\*{0,2}\w+(?:, \*{0,2}\w+)*) : (?=\S)")


def add_contents(app: Any, page: str, text: list[str]) -> None:
    """Append the contents of the site to its first page."""
    if page != root_doc:
        return
    for title, pages in CONTENTS.items():
        listed = "\n".join(pages)
        text[0] += f"\n```{{toctree}}\n:caption: {title}\n:hidden:\n:glob:\n\n{listed}\n```\n"


def mark_arguments(app: Any, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """Turn the lines `name : what it is` of a docstring, in place, into fields of Sphinx."""
    lines[:] = [ARGUMENT.sub(r"\1:param \2: ", line) for line in lines]


def write_index(app: Any, error: Exception | None) -> None:
    """Write the first page a second time, where a web server looks for it."""
    if error is None and app.builder.name == "html":
        site = Path(app.outdir)
        (site / "index.html").write_bytes((site / f"{root_doc}.html").read_bytes())


def write_inline_formula(translator: Any, node: nodes.math) -> None:
    """Write a formula as MathML, which browsers show without a script from elsewhere: labs are offline."""
    translator.body.append(str(tex2mathml(node.astext())))
    raise nodes.SkipNode


def write_formula(translator: Any, node: nodes.math_block) -> None:
    """Write a formula of its own line as MathML."""
    translator.body.append(str(tex2mathml(node.astext(), as_block=True)))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Connect these functions to Sphinx."""
    app.add_html_math_renderer("mathml", (write_inline_formula, None), (write_formula, None))
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", mark_arguments)
    app.connect("build-finished", write_index)
