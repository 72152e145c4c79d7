"""The diagnosis on the page: what its maps, marks and tables show."""

from __future__ import annotations

from lab.formats.results import DiagnosisResult, ExaminedPlace, NamedEffect, ResidualCurve, ResidualPicture, Visibility
from lab.report.answers import proof_curves
from lab.report.charts import residual_curve
from lab.report.diagnosis import context, mood, place_maps, worst_of_each

PLACES = tuple(
    ExaminedPlace(side="left", measurement=m, axis=axis, where=where, n=10, chi2_before=before, chi2_after=9.0,
    sigma_before=sigma, sigma_after=0.0)
    for m, axis, where, before, sigma in (
        ("a_new_one", "somewhere", "here", 9.0, 0.0),
        ("slanted_edge", "spatial_frequency", "0.1..0.2", 80.0, 5.5),
        ("slanted_edge", "spatial_frequency", "0.2..0.4", 9000.0, 1234.5),
    )
)  # fmt: skip
RESULT = DiagnosisResult(source="s", verdict="explained", threshold=12.0, places=PLACES)


def _curve(measurement: str, off: float, held_out: bool) -> ResidualCurve:
    return ResidualCurve(
        side="left", measurement=measurement, label=measurement, channel="G", axis="x", x=(1.0,), measured=(off,),
        measured_std=(1.0,), before=(0.0,), after=(0.0,), held_out=held_out,
    )  # fmt: skip


def test_a_long_quantity_is_broken_beside_its_axis() -> None:
    curve = _curve("flat_rows", 5.0, True).model_copy(update={"quantity": "power over noise, cube root"})
    assert residual_curve(curve)["layout"]["yaxis"]["title"]["text"] == "power over noise,<br>cube root"


def test_the_map_has_every_measurement_and_its_worst_place() -> None:
    ((title, figure),) = place_maps(RESULT, ("left", "right"))
    assert title == "left, baseline"
    (heat,) = figure["data"]
    assert heat["y"] == ["a new one", "transfer function of slanted edges"]
    assert heat["z"] == [[0.0, None], [None, 12.0]]  # the colour ends there
    assert "1234.5" in heat["customdata"][1][1]
    assert [note["text"] for note in figure["layout"]["annotations"]] == ["99+"]


def test_a_second_map_shows_what_named_effects_leave() -> None:
    named = NamedEffect(
        name="defocus",
        family="isotropic_contrast_loss",
        law="exact",
        probability=1.0,
        sides=("left",),
        parameters={},
        statement="",
    )
    maps = place_maps(RESULT.model_copy(update={"effects": (named,)}), ("left",))
    assert [title for title, _ in maps] == ["left, baseline", "left, improved model"]
    assert maps[1][1]["layout"]["annotations"] == []


def test_chi2_is_marked_above_what_noise_leaves() -> None:
    assert mood(10.0, 10) == ""
    assert mood(40.0, 10) == "open"  # the 99.9 % quantile is 29.6
    assert mood(0.0, 0) == ""


def test_each_measurement_shows_its_worst_curve_of_held_out_captures() -> None:
    curves = [_curve("a", 9.0, False), _curve("a", 2.0, True), _curve("a", 3.0, True), _curve("b", 5.0, False)]
    assert [(c.measurement, c.measured[0]) for c in worst_of_each(curves)] == [("b", 5.0), ("a", 3.0)]


def test_the_first_screen_shows_each_effect_in_its_own_measurement() -> None:
    """A weak effect isn't hidden by the two worst curves of a strong one."""

    def named(name: str, *shown_in: str) -> NamedEffect:
        return NamedEffect(
            name=name, family="isotropic_contrast_loss", law="exact", probability=1.0, sides=("left",), parameters={},
            statement="",
            shown_in=shown_in,
        )  # fmt: skip

    curves = tuple(
        _curve(name, off, True).model_copy(update={"x": (1.0, 2.0, 3.0, 4.0)})
        for name, off in (("edges", 9.0), ("patterns", 8.0), ("narrowband", 2.0))
    )
    result = RESULT.model_copy(update={"curves": curves})
    strong, weak = named("defocus", "patterns", "edges"), named("infrared_cut_filter", "narrowband")
    for effects, wanted in (
        ((strong, weak), ["patterns", "narrowband"]),
        ((strong,), ["patterns", "edges"]),
        ((named("coma"),), ["edges", "patterns"]),  # a result of before `shown_in`
        ((), []),
    ):
        told = proof_curves(result.model_copy(update={"effects": effects}))
        assert [curve.measurement for curve in told] == wanted


def test_tables_and_pictures_are_ready_for_the_page() -> None:
    seen = Visibility(
        side="right", effect="defocus", smallest={"defocus_um": 2.345}, nearest="coma", cosine=0.9, told_apart=0.7
    )
    shape = Visibility(
        side="right", effect="infrared_cut_filter", smallest={}, nearest=None, cosine=0.0, told_apart=1.0
    )
    picture = ResidualPicture(
        side="left", kind="flat", capture="f", held_out=True, before=((3.0, -3.0),), after=((1.0, 1.0),)
    )
    made = context(RESULT.model_copy(update={"visibility": (seen, shape), "pictures": (picture,)}), ("left", "right"))
    assert made["visibility"]["defocus"]["right"].smallest == "defocus 2.3 µm"
    assert made["visibility"]["infrared_cut_filter"]["right"].smallest == "detectable at any magnitude"
    assert (made["residual_pictures"][0].rms_before, made["residual_pictures"][0].rms_after) == ("3.00", "1.00")
    assert made["residual_pictures"][0].before.startswith("data:image/png;base64,")
    assert context(None, ("left",)) == {}
