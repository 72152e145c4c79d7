"""A discovered law as the draft of a new effect: its file for `sim/effects/`, and its test.

The draft acts as the law was found, with one parameter, the share of it that acts. It passes the contract of effects as
it stands, so that it can be concealed and looked for; a lab puts the physics in the place of the table.
"""

from __future__ import annotations

import keyword
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from lab.errors import InputError
from lab.formats.results import DiscoveredLaw
from sim.effects.base import STAGES
from sim.effects.empirical_law import PLACES, Along, EmpiricalLaw, Of, Stage
from sim.effects.families import Family
from sim.effects.library import effects as library
from sim.effects.library import list_changes

WIDTH = 120
#: Family of a drafted effect, by stage and index ("": any).
FAMILIES: dict[tuple[str, str], Family] = {
    ("light", ""): Family.SOURCE_IN_TIME,
    ("light", "wavelength"): Family.SOURCE_IN_WAVELENGTH,
    ("image", "radius"): Family.FIELD_OF_LIGHT,
    ("image", "angle"): Family.FIELD_OF_LIGHT,
    ("image", "wavelength"): Family.SPECTRAL_FILTER,
    ("image", "frequency"): Family.ISOTROPIC_CONTRAST,
    ("charge", ""): Family.RESPONSE,
    ("charge", "level"): Family.CHARGE_BETWEEN_NEIGHBOURS,
    ("charge", "radius"): Family.DARK_SIGNAL,
    ("signal", ""): Family.LINE_NOISE,
    ("signal", "level"): Family.RESPONSE,
    ("signal", "time"): Family.DARK_SIGNAL,
    ("signal", "exposure"): Family.DARK_SIGNAL,
    ("signal", "radius"): Family.DARK_SIGNAL,
    ("signal", "row x level"): Family.RESPONSE,
    ("signal", "column x level"): Family.RESPONSE,
    ("codes", ""): Family.CONVERTER,
}

#: What a test asks, by stage, index, and mean or variance: the expression that is found, and what is expected.
ASKED: dict[tuple[Stage, Along, Of], tuple[str, str]] = {
    ("light", "time", "mean"): ("[light_of(CAMERA, LAW).source(time) for time in {module}.AT]", "{module}.TABLE"),
    ("light", "plane x time", "mean"): (
        "[light_of(CAMERA, LAW).colour('Y', time) for time in {module}.AT]",
        "{module}.TABLE",
    ),
    ("light", "wavelength", "mean"): (
        "[np.average(FINE_NM, weights=light_of(CAMERA, LAW).radiance(FINE_NM, one, 'narrowband')) for one in LIT]",
        "np.add({module}.AT, {module}.TABLE)",
    ),
    ("image", "angle", "mean"): (
        "Uniform(CAMERA, LAW).shade_light(np.ones(len({module}.AT)), *CORNERS_UM)",
        "{module}.TABLE",
    ),
    ("image", "radius", "mean"): (
        "Uniform(CAMERA, LAW).shade_light(np.ones(len({module}.AT)), np.array({module}.AT), np.zeros(1))",
        "{module}.TABLE",
    ),
    ("image", "wavelength", "mean"): (
        "Uniform(CAMERA, LAW).transmittance(np.array({module}.AT))",
        "{module}.TABLE",
    ),
    ("image", "frequency", "mean"): (
        "np.real(image_of(CAMERA, LAW).otf_beside_lens(np.array({module}.AT), np.zeros(len({module}.AT)), 550.0))",
        "{module}.TABLE",
    ),
    ("charge", "row", "mean"): (
        "charge_of(CAMERA, LAW).collect_light(np.ones((2 * len({module}.TABLE), 8)))[:, 0]",
        "np.tile({module}.TABLE, 2)",
    ),
    ("charge", "column", "mean"): (
        "charge_of(CAMERA, LAW).collect_light(np.ones((8, 2 * len({module}.TABLE))))[0]",
        "np.tile({module}.TABLE, 2)",
    ),
    ("charge", "row and column", "mean"): (
        "charge_of(CAMERA, LAW).collect_light(np.ones(({period}, {columns}))).ravel()",
        "{module}.TABLE",
    ),
    ("charge", "exposure", "mean"): (
        "[charge_of(CAMERA, LAW).collected_s(asked_s) for asked_s in {module}.AT]",
        "np.multiply({module}.AT, {module}.TABLE)",
    ),
    ("charge", "radius", "mean"): (
        "charge_of(CAMERA, LAW).even_dark_e_per_s(5.0, None)[LINES // 2 - 1, LINES // 2 - 1 :]",
        "5.0 + np.interp(FROM_CENTRE_UM, {module}.AT, {module}.TABLE)",
    ),
    ("charge", "radius x exposure", "mean"): (
        "charge_of(CAMERA, LAW).leaked_s(np.full(LINES, 0.5), np.linspace(0.0, 1.0, LINES))[LINES // 2 :]",
        "np.interp(ACROSS_UM, {module}.AT, {module}.TABLE)",
    ),
    ("charge", "level", "variance"): (
        "charge_of(CAMERA, LAW).shot_e2(CAMERA.full_well_e * np.array({module}.AT))",
        "CAMERA.full_well_e * np.multiply({module}.AT, {module}.TABLE)",
    ),
    ("signal", "row", "mean"): ("Uniform(CAMERA, LAW).added_e[:, 0]", "BY_LINE"),
    ("signal", "column", "mean"): ("Uniform(CAMERA, LAW).added_e[0]", "BY_LINE"),
    ("signal", "row and column", "mean"): (
        "Uniform(CAMERA, LAW).added_e[:{period}, :{columns}].ravel()",
        "{module}.TABLE",
    ),
    ("signal", "row", "variance"): ("signal_of(CAMERA, LAW).random[0].variance_e2((LINES, LINES))[:, 0]", "BY_LINE"),
    ("signal", "column", "variance"): ("signal_of(CAMERA, LAW).random[0].variance_e2((LINES, LINES))[0]", "BY_LINE"),
    ("signal", "row", "covariance"): (
        "np.diff(signal_of(CAMERA, LAW).random[0].variance_e2((LINES, LINES))[::2, 0])",
        "np.diff((BY_LINE + np.append(0.0, BY_LINE[:-1]))[::2])",
    ),
    ("signal", "column", "covariance"): (
        "np.diff(signal_of(CAMERA, LAW).random[0].variance_e2((LINES, LINES))[0, ::2])",
        "np.diff((BY_LINE + np.append(0.0, BY_LINE[:-1]))[::2])",
    ),
    ("signal", "radius", "mean"): (
        "Uniform(CAMERA, LAW).added_e[LINES // 2 - 1, LINES // 2 - 1 :]",
        "np.interp(FROM_CENTRE_UM, {module}.AT, {module}.TABLE)",
    ),
    ("signal", "row x level", "mean"): (
        "signal_of(CAMERA, LAW).read(np.full((LINES, LINES), CAMERA.full_well_e))[:, 0] / CAMERA.full_well_e",
        "1.0 + BY_LINE",
    ),
    ("signal", "column x level", "mean"): (
        "signal_of(CAMERA, LAW).read(np.full((LINES, LINES), CAMERA.full_well_e))[0] / CAMERA.full_well_e",
        "1.0 + BY_LINE",
    ),
    ("signal", "time", "variance"): (
        "[signal_of(CAMERA, LAW).changing_e2(time) for time in {module}.AT]",
        "{module}.TABLE",
    ),
    ("signal", "exposure", "mean"): (
        "[signal_of(CAMERA, LAW).shift_dn(0.0, None, exposure_s) for exposure_s in {module}.AT]",
        "CAMERA.conversion_gain_dn_per_e * np.array({module}.TABLE)",
    ),
    ("signal", "level", "mean"): (
        "signal_of(CAMERA, LAW).read(CAMERA.full_well_e * np.array({module}.AT))",
        "CAMERA.full_well_e * np.multiply({module}.AT, {module}.TABLE)",
    ),
    ("signal", "time", "mean"): (
        "[signal_of(CAMERA, LAW).shift_dn(time, None, 0.01) for time in {module}.AT]",
        "CAMERA.conversion_gain_dn_per_e * np.array({module}.TABLE)",
    ),
    ("codes", "code", "mean"): (
        "np.bincount(np.rint(codes_of(CAMERA, LAW).convert(FINE)).astype(int))[{first}:][: len({module}.TABLE)]",
        "FINE_STEPS * np.array({module}.TABLE)",
    ),
}
#: The same of steps of the gain, by line.
ASKED_STEPS = {"row": "Uniform(CAMERA, LAW).gain_map()[:, 0]", "column": "Uniform(CAMERA, LAW).gain_map()[0]"}


def draft(law: DiscoveredLaw, number: int, source: str, file: Path) -> tuple[str, str]:
    """Write a discovered law as an effect named after `file`: its text, and that of its test.

    number, source : of the law among those of a diagnosis, and what was diagnosed
    Raises InputError where the file's name is no effect's.
    """
    name = file.stem
    if file.suffix != ".py" or not name.isidentifier() or name != name.lower() or keyword.iskeyword(name):
        raise InputError(f"{file}: an effect is named after its file; name one like sim/effects/unequal_codes.py")
    if name in library():
        raise InputError(f"{file}: there is an effect named {name} already; take another name")
    if law.curve_of or (law.stage, law.along, law.of) not in PLACES:
        what = f"a curve of the measurement {law.curve_of}" if law.curve_of else f"a curve by {law.along}"
        raise InputError(f"law {number} of {source}: is {what}, which no stage of the chain has; draft another law")
    fields = {"stage", "along", "of", "period", "columns", "first", "at", "table"}
    found = EmpiricalLaw.model_validate({**law.model_dump(include=fields), "strength": 1.0})
    return _effect(law, found, number, source, name), _test(law, found, name)


def place_of_test(file: Path) -> Path:
    """Return where a draft's test belongs: in the tests of effects, or beside a draft that is elsewhere."""
    tests = (
        file.absolute().parents[2] / "tests" / "sim" / "effects" if file.absolute().parent.name == "effects" else None
    )
    return (tests if tests is not None and tests.is_dir() else file.parent) / f"test_{file.name}"


def class_name(name: str) -> str:
    """Return the name of an effect's class."""
    return "".join(part.capitalize() for part in name.split("_"))


def _numbers(name: str, values: Sequence[float], comment: str) -> str:
    shown = ", ".join(f"{value:.8g}" for value in values)
    lines = textwrap.wrap(shown, WIDTH - 4)
    body = "\n".join(f"    {line}" for line in lines)
    return f"#: {comment}\n{name} = (\n{body},\n)  # fmt: skip\n"


def _wrapped(text: str, indent: str) -> str:
    return "\n".join(textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent))


def _string(text: str, indent: str) -> str:
    """Return a string literal in parentheses, over several lines."""
    safe = text.replace("\\", "").replace('"', "'")
    parts = textwrap.wrap(safe, WIDTH - len(indent) - 8, drop_whitespace=False)
    lines = "\n".join(f'{indent}    "{part}"' for part in parts)
    return f"(\n{lines}\n{indent})"


def _effect(law: DiscoveredLaw, found: EmpiricalLaw, number: int, source: str, name: str) -> str:
    place = cast("tuple[Stage, Along, Of]", (law.stage, law.along, law.of))
    quantity, _, coordinate = PLACES[place]
    stage = next(stage for stage in STAGES if any(one.startswith(f"{stage}.") for one in list_changes(found)))
    state = stage.capitalize()
    by_level = law.along == "level"
    at, level = found.at, ""
    if by_level:
        at = tuple(point / max(found.at) for point in found.at)
        coordinate = "share of the full well"
        level = f"        at = tuple({stage}.camera.full_well_e * share for share in AT)\n"
    points = _numbers("AT", at, f"{coordinate[0].upper()}{coordinate[1:]}, of each entry.") + "\n" if at else ""
    given = [f'stage="{law.stage}"', f'along="{law.along}"', *([f'of="{law.of}"'] if law.of != "mean" else [])]
    given += [f"period={found.period}", *([f"columns={found.columns}"] if found.columns else [])]
    given += [f"first={found.first}"] if found.first else []
    given += ["at=at" if by_level else "at=AT"] if at else []
    given += ["table=TABLE", "strength=self.strength"]
    call = "\n".join(textwrap.wrap(", ".join(given), WIDTH - 12, initial_indent=" " * 12, subsequent_indent=" " * 12))
    title = name.replace("_", " ")
    said = law.statement.removeprefix("No named effect accounts for this: ")
    said = f"{said[0].upper()}{said[1:]}"
    head = _wrapped(f"{title[0].upper()}{title[1:]}: drafted from law {number} of {Path(source).name}.", "")
    sentence = f"The {quantity} goes by {law.along}. {law.suspects[0].upper()}{law.suspects[1:]}."
    family = FAMILIES.get((law.stage, law.along)) or FAMILIES[law.stage, ""]
    return f'''"""{head}

{_wrapped(said.replace('"', "'"), "")}

To finish it: put the physics in the place of the table, with parameters that have units, and name its source.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from sim.effects.base import Effect
from sim.effects.empirical_law import EmpiricalLaw
from sim.effects.families import Family
from sim.parameters import Quantity
from sim.stages import {state}

{points}{_numbers("TABLE", found.table, f"{quantity[0].upper()}{quantity[1:]}.")}

class {class_name(name)}(Effect):
    """The table as it was found: {quantity}, by {law.along}."""

    name: ClassVar[str] = "{name}"
    family: ClassVar[Family] = Family.{family.name}
    reference: ClassVar[str] = "drafted from recordings; name the source of the law"
    form_tolerance: ClassVar[float] = 0.05
    sentence: ClassVar[str] = {_string(sentence, "    ")}

    strength: Annotated[
        float, Quantity("1", "share of the law as it was found", lower=0.0, upper=2.0, prior=(0.0, 1.0), absent=0.0)
    ] = 0.0

    def {STAGES[stage]}(self, {stage}: {state}) -> {state}:
{level}        law = EmpiricalLaw(
{call},
        )
        return law.{STAGES[stage]}({stage})
'''


def _test(law: DiscoveredLaw, found: EmpiricalLaw, name: str) -> str:
    place = cast("tuple[Stage, Along, Of]", (law.stage, law.along, law.of))
    asked, expected = ASKED[place]
    if law.stage == "charge" and found.at and law.along in {"row", "column"}:
        asked, expected = ASKED_STEPS[law.along], "BY_LINE / np.mean(BY_LINE)"
    by_line = f"np.interp((np.arange(LINES) + 0.5) / LINES, {name}.AT, {name}.TABLE)"
    by_line = by_line if found.at else f"np.resize({name}.TABLE, LINES)"
    values = {"module": name, "period": found.period, "columns": found.columns, "first": found.first or found.period}
    lines, tolerance = max(64, 2 * len(found.table)), "rtol=1e-6"
    if law.stage == "codes":
        tolerance = "atol=2.0"
    if "FINE_NM" in asked:
        tolerance = "atol=0.01"
    states = sorted({one for one in ("light_of", "image_of", "charge_of", "signal_of", "codes_of") if one in asked})
    imports = [f"from sim.stages import {', '.join(states)}"] if states else []
    imports += ["from sim.uniform import Uniform"] if "Uniform" in asked else []
    constants = [f"LINES = {lines}"]
    after = []
    if "BY_LINE" in expected:
        after.append(f"BY_LINE = {by_line}")
    if "CORNERS_UM" in asked:
        after.append("HALF_UM = 0.5 * CAMERA.pixel_pitch_um * np.hypot(LINES, LINES)")
        after.append(f"TURN = np.radians({name}.AT)")
        after.append("CORNERS_UM = HALF_UM * np.cos(TURN), HALF_UM * np.sin(TURN)")
    if "ACROSS_UM" in expected:
        after.append("ACROSS_UM = CAMERA.pixel_pitch_um * (np.arange(LINES // 2) + 0.5)")
    if "FINE_NM" in asked:
        after.append("FINE_NM = np.arange(350.0, 1050.5, 0.5)")
        after.append(f"LIT = np.exp(-0.5 * ((FINE_NM - np.reshape({name}.AT, (-1, 1))) / 5.0) ** 2)")
    if "FROM_CENTRE_UM" in expected:
        after.append("FROM_CENTRE_UM = CAMERA.pixel_pitch_um * np.hypot(0.5, np.arange(LINES // 2 + 1) - 0.5)")
    if law.stage == "codes":
        first, last = values["first"], (found.first or found.period) + len(found.table)
        after += ["FINE_STEPS = 200  # of a code", f"FINE = np.arange({first} - 0.5, {last} - 0.5, 1.0 / FINE_STEPS)"]
        after[-1] += " + 0.5 / FINE_STEPS"
    block = "\n".join(after) + "\n" if after else ""
    listed = "\n".join(imports)
    title = name.replace("_", " ")
    return f'''"""{title[0].upper()}{title[1:]}, as it was drafted: whole, it is the table that was found."""

from __future__ import annotations

import numpy as np

from sim.camera import CameraModel, Lens
from sim.effects import {name}
from sim.effects.library import list_changes
from sim.spectrum import Spectrum
{listed}

{chr(10).join(constants)}
CAMERA = CameraModel(
    rows=LINES, cols=LINES, pixel_pitch_um=3.0, fill_factor=1.0, cfa="MONO", bit_depth=16, black_level_dn=64.0,
    white_level_dn=65535.0,
    conversion_gain_dn_per_e=0.4, full_well_e=10000.0, read_noise_e=2.0, dark_current_e_per_s=5.0, dsnu_e=0.0,
    prnu_percent=0.0,
    quantum_efficiency={{"Y": Spectrum.of((400.0, 700.0), (0.5, 0.5))}}, lens=Lens(f_number=4.0, focal_length_mm=8.0),
)  # fmt: skip
LAW = ({name}.{class_name(name)}(strength=1.0),)
{block}

def test_absent_it_has_no_law() -> None:
    assert not list_changes({name}.{class_name(name)}())


def test_the_whole_law_is_the_table_that_was_found() -> None:
    found = {asked.format(**values)}
    np.testing.assert_allclose(found, {expected.format(**values)}, {tolerance})
'''
