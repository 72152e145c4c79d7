"""Without a known conversion gain nothing is told in electrons: figures are in DN."""

from __future__ import annotations

from lab.diagnose import diagnose
from lab.diagnose.outcome.goodness_of_fit import told_as
from lab.formats.recording_set import RecordingSet
from lab.formats.results import Visibility
from lab.report.diagnosis import _visibility
from mocks.former.laws import RowNoiseLaw
from sim.effects.amplifier_glow import AmplifierGlow
from sim.effects.row_noise import RowNoise
from tests.lab.diagnose.metadata.lies import restated
from tests.lab.diagnose.on_blocks import former


def test_only_electrons_are_told_in_dn() -> None:
    glow, rows = AmplifierGlow.quantities(), RowNoise.quantities()
    assert told_as("glow_e_per_s", glow["glow_e_per_s"], gain_is_known=False) == ("glow_dn_per_s", "DN/s")
    assert told_as("noise_e", rows["noise_e"], gain_is_known=False) == ("noise_dn", "DN")
    assert told_as("noise_e", rows["noise_e"], gain_is_known=True) == ("noise_e", "e")
    assert told_as("correlation", rows["correlation"], gain_is_known=False) == ("correlation", "1")


def _darks() -> RecordingSet:
    return former(5, RowNoiseLaw(RowNoiseLaw.nominal, 0), kinds=("dark",))


def test_dark_frames_of_a_camera_of_unknown_gain_have_row_noise_in_dn() -> None:
    """The same frames with and without a stated gain: the figures differ by it."""
    recordings = _darks()
    gain = 0.5
    with_gain, without = (
        diagnose(restated(recordings, conversion_gain_dn_per_e=value, read_noise_e=None)) for value in (gain, None)
    )
    (known,), (unknown,) = with_gain.effects, without.effects
    assert (known.name, unknown.name) == ("row_noise", "row_noise")
    in_e, in_dn = known.parameters["noise_e"], unknown.parameters["noise_dn"]
    assert (in_e.unit, in_dn.unit) == ("e", "DN")
    # the priors of sizes are in electrons: they move the estimate by less than its standard deviation
    assert abs(in_dn.value - gain * in_e.value) < in_dn.std
    assert f"{in_dn.std:.3f} DN" in unknown.statement
    assert " e," not in unknown.statement
    assert any(s.step == "diagnose conversion_gain_dn_per_e" and "in DN" in s.reason for s in without.skipped)
    assert not any(s.step == "diagnose conversion_gain_dn_per_e" for s in with_gain.skipped)
    sizes = {field for item in without.visibility for field in item.smallest}
    assert not any(field.endswith("_e") or "_e_per_s" in field for field in sizes)


def test_the_table_of_detectable_sizes_has_their_units() -> None:
    for field, unit in (("rate_dn_per_s", "DN/s"), ("rate_e_per_s", "e/s")):
        item = Visibility(
            side="left", effect="ambient_light", smallest={field: 2.0}, nearest=None, cosine=0.0, told_apart=1.0
        )
        assert _visibility([item])["ambient_light"]["left"].smallest.endswith(f"2 {unit}")
