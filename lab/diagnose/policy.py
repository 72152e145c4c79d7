"""The decision policy: every number by which a diagnosis decides, with its meaning, its unit, its bounds and where its
value comes from.

Odds are natural logarithms throughout ("log odds"): 2.3 is ten to one, 4.6 is a hundred to one. A score is the gain in
chi2 that an effect's signature promises: twice its log odds.

Values marked `TUNED` have no derivation. They were set on tuning seeds of the evaluation, and each states a value at
which it doesn't act (`Rule.off`). `python -m evaluation calibrate --each` takes them out one by one and counts right
and false names of tuning cases; `--rule NAME=VALUE` scores the cases under any other value.
docs/reference/decision-policy.md is generated from this module by docs/write_tables.py. It says, too, which numbers
stay beside their use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import Field

from lab.formats.results import PolicyRule
from sim.parameters import Frozen

TUNED = "tuned: `python -m evaluation calibrate`"


@dataclass(frozen=True)
class Rule:
    """Declaration of one field: its group, its unit ("1": a share, a ratio or a count), its meaning, where its value
    comes from, and its upper bound; the lower one is 0. `off`: the value at which the rule doesn't act, of those that
    have no derivation."""

    group: str
    unit: str
    meaning: str
    basis: str
    most: float | None = None
    off: float | None = None


def rule(group: str, value: float, unit: str, meaning: str, basis: str, **limits: float) -> Any:
    """Return a field of the policy with its default value. `limits`: `most` and `off` of its `Rule`."""
    declared = Rule(group, unit, meaning, basis, **limits)
    return Field(value, ge=0, le=declared.most, json_schema_extra={"rule": declared})  # type: ignore[dict-item]


class DecisionPolicy(Frozen):
    """All rules of decision. An instance is passed to `lab.diagnose.examine` and stored in its result."""

    # fmt: off
    # --- significance -------------------------------------------------------------------------------------------------
    false_alarm_rate: float = rule("significance", 0.01, "1",
        "share of healthy cameras whose best score exceeds the threshold",
        "chosen; checked by `python -m evaluation score` on healthy cases, and per camera by `calibench diagnose "
        "--bootstrap`", most=1.0)
    threshold_draws: int = rule("significance", 400, "1",
        "draws of noise behind the threshold",
        "4 of 400 draws lie above the 99 % quantile, so that its rate is known to 50 % and the threshold to 2 ln "
        "1.5 = 0.8 of about 15")
    slice_false_alarm_rate: float = rule("significance", 0.005, "1",
        "probability, corrected for the number of slices, below which a slice is a mismatch",
        "half of `false_alarm_rate`: slices add at most half as many false alarms as scores", most=1.0)
    held_out_false_alarm_rate: float = rule("significance", 0.005, "1",
        "probability, corrected for the number of measurements, below which held-out numbers contradict the model",
        "as `slice_false_alarm_rate`", most=1.0)
    discovery_rate: float = rule("significance", 0.005, "1",
        "false discoveries among the laws that are told though no effect has them, by Benjamini and Yekutieli",
        "chosen: a camera is looked at along five indices, and one healthy camera in a hundred may show one", most=1.0)
    least_discovery_share: float = rule("significance", 0.1, "1",
        "share of chi2 along its index that a law no effect has must take off to be told",
        "chosen: below, most of what is seen along that index is something else", most=1.0)
    superseding_chi2: float = rule("significance", 14.0, "1",
        "by how much more than a named effect a law that no effect has must take off chi2, beyond two for each of its "
        "numbers, to be told in its place",
        "chosen: twice ln 1000, a thousand to one")
    unrivalled_probability: float = rule("significance", 0.999999, "1",
        "probability of a name from which on no law without a name is tried in its place",
        "chosen: a search along all coordinates for each name takes a second", most=1.0)
    held_out_veto_sigma: float = rule("significance", 2.33, "standard deviations",
        "quantile z of noise: by a right name the held-out chi2 rises by no more than z^2",
        "one-sided 99 % of a normal distribution, 1 - `false_alarm_rate`")
    covariance_slack: float = rule("significance", 0.15, "1",
        "relative error of stated standard deviations; chi2 is divided by (1 + slack)^2",
        TUNED, most=1.0, off=0.0)
    corner_tolerance_px: float = rule("significance", 0.2, "px",
        "standard deviation of a corner's coordinate beyond noise, up to which boards are taken as flat and as "
        "printed",
        "twice the 0.11 px that plain boards of public stereo pairs leave beside Brown's distortion "
        "(docs/explanation/accuracy.md)")
    most_outlying_share: float = rule("significance", 0.3, "1",
        "largest share of a measurement's captures that may be outlying",
        "of more, none can be told from the others", most=1.0)
    alike_outlying_sigma: float = rule("significance", 4.0, "standard deviations",
        "distance within which outlying captures of one setting are off by the same factor",
        "two-sided 99.99 % of a normal distribution")
    lone_score_margin: float = rule("significance", 10.0, "score",
        "excess of the best score over the threshold that is a mismatch where neither a slice nor a refit shows "
        "one",
        TUNED, off=0.0)

    # --- cost of a model ----------------------------------------------------------------------------------------------
    parameter_log_odds: float = rule("cost of a model", 2.5, "log odds",
        "gain in log-likelihood that a fitted parameter has to earn",
        "BIC, 0.5 ln n: 2.5 for n = 150 independent numbers, 2.9 for 300")
    included_log_odds: float = rule("cost of a model", 3.8, "log odds",
        "prior log odds against a listed effect being there",
        "ln 45: one of the library's effects a camera")
    dispensable_log_odds: float = rule("cost of a model", 8.0, "log odds",
        "gain that a parameter declared dispensable has to earn besides",
        "about half of a usual threshold (15 to 18 in chi2), as a further effect has to")
    discrepancy_log_odds: float = rule("cost of a model", 5.0, "log odds",
        "gain that a model discrepancy has to earn",
        "logarithm of the number of kernels that differ: 20 amplitudes x 3 lengths x 4 groupings = 240 are tried, "
        "of which neighbouring amplitudes are nearly alike: about 150")
    exchange_log_odds: float = rule("cost of a model", 0.5, "log odds",
        "gain from which on leaving out or exchanging a member counts as better",
        "what refits of the same set from different starts differ by")
    least_tolerated_share: float = rule("cost of a model", 0.1, "1",
        "least share of the laws' form tolerances by which sets of effects are compared, each by its likeliest",
        "a tenth of a declared tolerance is below the noise up to changes of 200 standard deviations (5 %); 1 "
        "takes the declared ones as they are", most=1.0)
    beside_tolerance: float = rule("cost of a model", 0.02, "1",
        "least share of its own change by which any law may be wrong where a further effect beside it is weighed",
        "chosen: 0.5 % of the transfer, as lenses depart from any law, of a filter that takes a quarter of it",
        most=1.0)
    misstated_ratio: float = rule("cost of a model", 1.1, "1",
        "factor from which on a fitted f-number or pitch counts as another one than stated",
        "f-numbers are marked in thirds of a stop, a factor of 1.12")
    sure_misstated_log_odds: float = rule("cost of a model", 30.0, "log odds",
        "gain of a misstated f-number or pitch from which on rivals aren't weighed",
        "a probability of exp(-30) changes no decision")

    # --- name ---------------------------------------------------------------------------------------------------------
    least_probability: float = rule("name", 0.5, "1",
        "least probability of a name",
        "likelier than not", most=1.0)
    least_inclusion_probability: float = rule("name", 0.9, "1",
        "least probability that a named effect is there, against the same set without it and with "
        "`included_log_odds` as its prior",
        "odds of 9 to 1; with `parameter_log_odds`, one parameter has to gain 17 in chi2, which noise reaches in "
        "one of 27 000 effects that are tried", most=1.0)
    least_size_sigma: float = rule("name", 2.0, "standard deviations",
        "distance from absence that at least one parameter which sizes a named effect has",
        "95 % of a normal distribution: what is within it isn't told as a size")
    least_means_log_odds: float = rule("name", 4.6, "log odds",
        "least gain in log-likelihood, in the numbers that aren't variances, of an effect that changes variances "
        "by changing the mean response",
        "ln(1 / `false_alarm_rate`): without the effect, a likelihood ratio exceeds 1 / p with a probability of p "
        "at most (Markov)")
    family_probability: float = rule("name", 0.8, "1",
        "least probability that a family's members hold together, if the cause is a listed effect; and below "
        "which its likeliest member isn't named beside others of the family that fit",
        "odds of 4 to 1, chosen", most=1.0)
    family_least_share: float = rule("name", 0.76, "1",
        "least share of the excess chi2, in the measurements that its nearest law acts on, that a family of which "
        "no law holds explains",
        "a straight line explains three quarters of a step, so that a difference between taps would be uneven "
        "light by less", most=1.0)
    least_explained_share: float = rule("name", 0.8, "1",
        "least share of the excess chi2, in the measurements that an effect acts on, that its name explains",
        TUNED, most=1.0, off=0.0)
    least_explained_share_open: float = rule("name", 0.98, "1",
        "the same where what is left exceeds noise and form tolerances",
        "a filter beside a ripple without a law is no vibration of 96 % "
        "(`tests/lab/diagnose/inference/test_decide.py`); " + TUNED, most=1.0, off=0.8)
    near_share: float = rule("name", 0.5, "1",
        "least share of the excess chi2 of a measurement that a law explains which is told as the nearest",
        "chosen: it explains more than it leaves", most=1.0)
    noise_sigma: float = rule("name", 3.0, "standard deviations",
        "excess of chi2 over its expectation up to which what is left counts as noise",
        "one-sided 99.9 % of a normal distribution")
    remainder_log_odds: float = rule("name", 3.0, "log odds",
        "gain of a discrepancy that never speaks against a name",
        "odds of 20 to 1")
    remainder_share: float = rule("name", 0.02, "1",
        "gain of a discrepancy in the measurement that shows a name most, over the name's gain, above which both "
        "count as one unknown cause",
        "chosen: 2 % may be left", most=1.0)
    equal_mode_log_odds: float = rule("name", 2.0, "log odds",
        "difference within which two modes of a parameter, both signs for one, count as equally likely",
        "a likelihood ratio of two standard deviations: 2^2 / 2")
    same_mode_share: float = rule("name", 0.1, "1",
        "distance of two refits, as a share of the effect's size, within which they found the same mode",
        "chosen", most=1.0)

    # --- budget of the search -----------------------------------------------------------------------------------------
    most_effects: int = rule("budget of the search", 4, "1",
        "effects in one set",
        "chosen: twice what the proof's compounds have")
    refitted_sets: int = rule("budget of the search", 10, "1",
        "sets refitted in one step, and rivals of one name, the best in closed form",
        "chosen: all sets of that size are compared in closed form before")
    refitted_pairs: int = rule("budget of the search", 5, "1",
        "pairs refitted in the place of one effect, or beside a set, where no single effect betters it",
        "chosen: half of `refitted_sets`, as they come last")
    added_effects: int = rule("budget of the search", 3, "1",
        "effects that one step adds to a set, where fewer by themselves aren't seen",
        "chosen: one less than `most_effects`")
    search_steps: int = rule("budget of the search", 12, "1",
        "steps of the search, each of which adds an effect or exchanges one",
        "chosen: three for each of `most_effects`")
    promised_share: float = rule("budget of the search", 0.4, "1",
        "share of a name's gain that an effect promises in closed form, from which on it is fitted in its place; "
        "and of the best score beside a set, from which on an effect is added",
        "a refit of a large effect may gain two and a half times what its small signature promises; " + TUNED,
        most=1.0, off=0.0)
    search_cpu_s: float = rule("budget of the search", 120.0, "s",
        "CPU time of one side's search after which no further set is refitted, and no rival; these are listed",
        "chosen: the evaluation's limit for a whole diagnosis")
    rival_cosine: float = rule("budget of the search", 0.75, "1",
        "cosine of two whitened signatures from which on two effects are rivals",
        "at a non-centrality of 25 (detected in 93 % of cases) rivals are told apart in less than 95 %: Phi(0.5 "
        "sqrt(25 (1 - 0.75^2))) = 0.951", most=1.0)
    certain_probability: float = rule("budget of the search", 0.99, "1",
        "probability from which on a name isn't weighed again when another member changes",
        "`false_alarm_rate` for wrong names", most=1.0)
    hopeless_log_odds: float = rule("budget of the search", 30.0, "log odds",
        "distance of a rival that no discrepancy beside it makes up for",
        "a probability of exp(-30) changes no decision")

    # --- model discrepancy --------------------------------------------------------------------------------------------
    left_out_parts: int = rule("model discrepancy", 6, "1",
        "parts of a measurement's captures that are left out in turn",
        "chosen: 6-fold cross-validation")
    equal_discrepancy_log_odds: float = rule("model discrepancy", 10.0, "log odds",
        "difference within which cross-validation decides between kernels where repeats are held out",
        "twice `discrepancy_log_odds`")
    repeat_distance: float = rule("model discrepancy", 0.1, "correlation lengths",
        "distance within which two numbers of one channel and condition are repeats",
        "a squared exponential's correlation is 0.995 there")

    # --- metadata -----------------------------------------------------------------------------------------------------
    longest_usual_exposure_s: float = rule("metadata", 60.0, "s",
        "longest likely exposure: exposures too long for seconds are read in the larger unit that gives none above it",
        "chosen")
    least_swapped_frames: int = rule("metadata", 3, "1",
        "darks, and flats, from which on the two kinds may be found stated for each other",
        "chosen")
    clipped_pixels: int = rule("metadata", 100, "1",
        "pixels at the highest code from which on a frame counts as clipped",
        "chosen: read noise puts a few at a frame's highest code")
    clipped_frame_share: float = rule("metadata", 1e-3, "1",
        "the same as a share of a frame",
        "chosen: hot pixels are fewer", most=1.0)
    least_bit_depth: int = rule("metadata", 6, "bits",
        "least bit depth that clipped frames may show",
        "of fewer bits, the highest code is too likely to be any level")
    dark_exposure_chance: float = rule("metadata", 1e-6, "1",
        "probability that noise takes one exposure's mean dark level as far off the line of the others",
        "chosen: small beside `false_alarm_rate` for ten exposures", most=1.0)
    dark_exposure_tolerance: float = rule("metadata", 0.05, "1",
        "relative error of a dark frame's exposure that is a misstatement, beside two standard deviations",
        "a wrong shutter is off by more, and the dark current of a sensor that warms changes by as much", most=1.0)
    dark_exposure_most_factor: float = rule("metadata", 5.0, "1",
        "largest factor by which a dark frame's exposure may be misstated",
        "a dark level that is farther off has another cause")
    dark_exposure_least_probability: float = rule("metadata", 1e-3, "1",
        "least probability of what the other exposures leave about their line",
        "chosen: below, a wrong exposure isn't the whole cause", most=1.0)
    black_level_tolerance: float = rule("metadata", 5.0 / 4096.0, "1",
        "tolerance of a stated black level, as a share of the converter's range (5 DN of 12 bits)",
        "data sheets round it, and it depends on temperature", most=1.0)
    black_level_least_tolerance_dn: float = rule("metadata", 1.0, "DN",
        "least tolerance of a stated black level",
        "it is stated in whole codes")
    black_level_sigma: float = rule("metadata", 5.0, "standard deviations",
        "distance of the measured black level from the tolerance that is a misstatement",
        "as `shown_chi2`")
    least_lights: int = rule("metadata", 4, "1",
        "lights, narrowband or of a chart, from which on two may be found exchanged",
        "chosen: two, and two to compare them with")
    unknown_level_error: float = rule("metadata", 0.1, "1",
        "median rms of ln(rate) from which on levels of lights count as unknown, as those of relative spectra",
        "chosen: radiometers and sensitivity curves are right to some per cent")
    exchanged_out_of_line: float = rule("metadata", 5.0, "1",
        "least error of each of two exchanged narrowband lights, over the median error of all",
        "chosen: curves of makers are smooth, so that an exchange stands out")
    exchanged_better: float = rule("metadata", 0.25, "1",
        "largest error of each after the exchange, over that before",
        "chosen", most=1.0)
    exchanged_patches_out_of_line: float = rule("metadata", 1.5, "1",
        "least rms error of two exchanged lights of a chart, over the median error of all",
        "chosen: printed patches have errors of some per cent in any light")
    exchanged_patches_better: float = rule("metadata", 0.5, "1",
        "largest rms error after the exchange, over that before",
        "as `exchanged_patches_out_of_line`", most=1.0)
    exchanged_surer: float = rule("metadata", 0.7, "1",
        "largest error of the best exchange over that of any other with one of its lights",
        "chosen", most=1.0)
    mosaic_least_lights: int = rule("metadata", 3, "1",
        "lights and patches from which on the order of a mosaic's colours is checked",
        "chosen")
    mosaic_bright: float = rule("metadata", 10.0, "1",
        "least signal of a light over the uncertainty of the dark level",
        "its rate is then right to 10 %, less than `mosaic_least_error`")
    mosaic_least_error: float = rule("metadata", 0.15, "1",
        "rms of ln(rate) up to which the stated order of colours holds",
        "errors of sensitivity curves and crosstalk are smaller")
    mosaic_better: float = rule("metadata", 0.5, "1",
        "largest error of the best order of colours over that of the stated one",
        "chosen", most=1.0)
    mosaic_surer: float = rule("metadata", 0.75, "1",
        "largest error of the best order of colours over that of the next best",
        "chosen", most=1.0)
    mosaic_most_gain: float = rule("metadata", 0.7, "1",
        "largest logarithm by which a channel's gain may differ from the maker's curve",
        "chosen: a factor of two")
    cell_size_tolerance: float = rule("metadata", 0.05, "1",
        "relative tolerance of the stated size of a screen's cells",
        "the stated size is nominal, and cells of a tilted screen differ over the frame", most=1.0)
    board_frames: int = rule("metadata", 2, "1",
        "least frames of a board that show another layout than stated",
        "chosen")
    board_fit: float = rule("metadata", 0.15, "marker sides",
        "largest rms distance of markers' centres from the homography of a layout that fits",
        "chosen: distortion gives some hundredths")
    board_rival_ratio: float = rule("metadata", 5.0, "1",
        "least distance of any other layout over that of the one that fits",
        "chosen: of another number of columns, markers lie whole squares off")
    absent_markers: int = rule("metadata", 4, "1",
        "markers that should be in view and aren't found, from which on a stated row counts as missing",
        "chosen: a detector misses one or two")
    marker_tolerance: float = rule("metadata", 0.15, "1",
        "relative tolerance of a marker's side",
        "detection finds a blurred dark marker up to 7 % too small", most=1.0)
    marker_tolerance_px: float = rule("metadata", 2.0, "px",
        "least tolerance of a marker's side in the frame",
        "chosen: a pixel at each end")

    # --- report -------------------------------------------------------------------------------------------------------
    shown_chi2: float = rule("report", 25.0, "1",
        "chi2 of an effect's change from which on a measurement is said to show it",
        "five standard deviations")
    shown_share: float = rule("report", 0.02, "1",
        "its least share of the strongest measurement's",
        "chosen", most=1.0)
    detection_probability: float = rule("report", 0.9, "1",
        "probability at which the smallest detectable size is stated",
        "chosen", most=1.0)
    least_rival_probability: float = rule("report", 0.005, "1",
        "least probability of a rival that is listed",
        "half of `false_alarm_rate`; rival sets' coverage: `python -m evaluation score`", most=1.0)
    model_set_share: float = rule("report", 0.95, "1",
        "probability that the listed sets of effects hold together",
        "chosen; tests on linear problems: such sets hold the truth as often", most=1.0)
    next_capture_share: float = rule("report", 0.9, "1",
        "probability that the rivals which a next capture is to tell apart hold together",
        "chosen", most=1.0)
    next_capture_rivals: int = rule("report", 4, "1",
        "how many these are at most",
        "chosen: each is refitted")
    next_capture_distance: float = rule("report", 2.0, "1",
        "D = 1/2 |m_k - m_l|^2 from which on a capture is worth taking",
        "decides rightly with probability Phi(sqrt(D / 2)) = 0.84")
    next_captures_listed: int = rule("report", 5, "1",
        "captures that are listed",
        "chosen")
    resolve_least_share: float = rule("report", 0.2, "1",
        "share of a doubt's entropy that a capture, or two together, must be expected to tell to be taken",
        "rivals `next_capture_distance` apart are told to 0.32 of their entropy at equal odds, to 0.21 at 19 to 1",
        most=1.0)
    told_rival_probability: float = rule("report", 0.05, "1",
        "probability from which on a rival is told beside the nearest law",
        "chosen", most=1.0)
    described_share: float = rule("report", 0.5, "1",
        "share of a mismatch's excess of chi2 that a discovered law which describes it takes off",
        "as `near_share`", most=1.0)
    next_capture_least_distance: float = rule("report", 0.02, "1",
        "distance D below which a capture isn't listed beside others",
        "predictions within a fifth of a standard deviation")
    # fmt: on

    @classmethod
    def rules(cls) -> dict[str, Rule]:
        """Return the declaration of every field, in order."""
        return {name: field.json_schema_extra["rule"] for name, field in cls.model_fields.items()}  # type: ignore[index, misc]

    def told(self) -> tuple[PolicyRule, ...]:
        """Every field with its value, as a result states it."""
        return tuple(
            PolicyRule(name=name, group=rule.group, value=getattr(self, name), unit=rule.unit, meaning=rule.meaning)
            for name, rule in self.rules().items()
        )


#: The policy where none is given.
DEFAULT_POLICY = DecisionPolicy()
