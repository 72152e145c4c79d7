"""Charts of other packages: what is refused, and the contract on a chart whose patches are exchanged."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sim.scene import catalogue, chart, chart_contract, colorchecker
from sim.scene.chart import PatchChart
from sim.spectrum import Spectrum


def even(value: float, first_nm: float = 380.0, last_nm: float = 730.0) -> Spectrum:
    return Spectrum.of([first_nm, last_nm], [value, value])


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ((" ", 1, 1, {"a": even(0.5)}), "doesn't say what it shows"),
        (("x", 1, 2, {"a": even(0.5)}), "1 reflectances for 1 rows of 2 patches"),
        (("x", 1, 1, {"a": even(1.2)}), "patch a: reflectance 1.2 is outside 0..1"),
        (("x", 1, 1, {"a": even(-0.01)}), "patch a: reflectance -0.01 is outside 0..1"),
        (("x", 1, 1, {"a": even(0.5, 400.0)}), "patch a: reflectance over 400..730 nm: 380..730 nm are needed"),
    ],
)
def test_what_is_no_chart_is_refused_in_one_line(given: tuple[str, int, int, dict[str, Spectrum]], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        PatchChart(*given)
    with pytest.raises(ValueError, match=r"the gap between patches is 0.95"):
        PatchChart("x", 1, 1, {"a": even(0.5)}, gap=0.95)


def test_the_ends_are_held_and_what_reaches_beyond_is_cut() -> None:
    short, wide = Spectrum.of([380, 500, 730], [0.2, 0.5, 0.7]), Spectrum.of([200, 1200], [0.0, 1.0])
    found = PatchChart("x", 1, 2, {"short": short, "wide": wide}).reflectances
    assert found["short"].at([300.0, 380.0, 500.0, 1100.0]).tolist() == [0.2, 0.2, 0.5, 0.7]
    assert found["wide"].wavelength_nm == (300.0, 1100.0)
    assert found["wide"].value == pytest.approx((0.1, 0.9), abs=1e-12)  # the line itself


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[PatchChart]:
    """A chart of three rows of two patches, as if a package had added it."""
    ours = PatchChart("steps", 3, 2, {f"{i}": even(0.15 * i) for i in range(6)})
    monkeypatch.setattr(chart, "extensions", lambda group: [("steps", ours)] if group == "charts" else [])
    for kept in (chart.added_charts, catalogue.scenes, colorchecker.reflectances):
        kept.cache_clear()
    yield ours
    monkeypatch.undo()
    for kept in (chart.added_charts, catalogue.scenes, colorchecker.reflectances):
        kept.cache_clear()


def test_an_added_chart_keeps_the_contract_and_exchanged_patches_do_not(installed: PatchChart) -> None:
    assert colorchecker.grid("steps") == (3, 2)
    assert chart_contract.complaints("steps", installed) == ()
    turned = PatchChart("steps", 3, 2, dict(reversed(installed.reflectances.items())))
    lines = chart_contract.complaints("steps", turned)
    assert len(lines) == 6 and lines[0].startswith("patch 5: drawn it gives 0.0")
