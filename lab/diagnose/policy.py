"""The decision policy: every number by which a diagnosis decides, with its meaning, its unit and where its value comes
from.

Odds are natural logarithms throughout ("log odds"): 2.3 is ten to one, 4.6 is a hundred to one. A score is the gain in
chi2 that an effect's signature promises: twice its log odds.

Values marked `TUNED` have no derivation. They were set on tuning seeds of the challenge, and each states a value at
which it doesn't act (`Rule.off`). `calibench challenge calibrate --each` takes them out one by one and counts right and
false names of tuning cases; `--rule NAME=VALUE` scores the cases under any other value.
docs/reference/decision-policy.md is generated from this module by docs/write_tables.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, get_args, get_type_hints

from lab.formats.results import PolicyRule
from sim.parameters import Frozen

TUNED = "tuned: `calibench challenge calibrate`"


@dataclass(frozen=True)
class Rule:
    """Declaration of one field: its group, its unit ("1": a share, a ratio or a count), its meaning, and where its
    value comes from. `off`: the value at which the rule doesn't act, of those that have no derivation."""

    group: str
    unit: str
    meaning: str
    basis: str
    off: float | None = None


class DecisionPolicy(Frozen):
    """All rules of decision. An instance is passed to `lab.diagnose.examine` and stored in its result."""

    # --- significance -------------------------------------------------------------------------------------------------
    false_alarm_rate: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "share of healthy cameras whose best score exceeds the threshold",
            "chosen; checked by `calibench challenge score` on healthy cases, and per camera by `calibench diagnose "
            "--bootstrap`",
        ),
    ] = 0.01
    threshold_draws: Annotated[
        int,
        Rule(
            "significance",
            "1",
            "draws of noise behind the threshold",
            "4 of 400 draws lie above the 99 % quantile, so that its rate is known to 50 % and the threshold to 2 ln "
            "1.5 = 0.8 of about 15",
        ),
    ] = 400
    slice_false_alarm_rate: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "probability, corrected for the number of slices, below which a slice is a mismatch",
            "half of `false_alarm_rate`: slices add at most half as many false alarms as scores",
        ),
    ] = 0.005
    held_out_false_alarm_rate: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "probability, corrected for the number of measurements, below which held-out numbers contradict the model",
            "as `slice_false_alarm_rate`",
        ),
    ] = 0.005
    discovery_rate: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "false discoveries among the laws that are told though no effect has them, by Benjamini and Yekutieli",
            "chosen: a camera is looked at along five indices, and one healthy camera in a hundred may show one",
        ),
    ] = 0.005
    least_discovery_share: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "share of chi2 along its index that a law no effect has must take off to be told",
            "chosen: below, most of what is seen along that index is something else",
        ),
    ] = 0.1
    superseding_chi2: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "by how much more than a named effect a law that no effect has must take off chi2, beyond two for each of "
            "its numbers, to be told in its place",
            "chosen: twice ln 1000, a thousand to one",
        ),
    ] = 14.0
    unrivalled_probability: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "probability of a name from which on no law without a name is tried in its place",
            "chosen: a search along all coordinates for each name takes a second",
        ),
    ] = 0.999999
    held_out_veto_sigma: Annotated[
        float,
        Rule(
            "significance",
            "standard deviations",
            "quantile z of noise: by a right name the held-out chi2 rises by no more than z^2",
            "one-sided 99 % of a normal distribution, 1 - `false_alarm_rate`",
        ),
    ] = 2.33
    covariance_slack: Annotated[
        float,
        Rule(
            "significance",
            "1",
            "relative error of stated standard deviations; chi2 is divided by (1 + slack)^2",
            TUNED,
            off=0.0,
        ),
    ] = 0.15
    corner_tolerance_px: Annotated[
        float,
        Rule(
            "significance",
            "px",
            "standard deviation of a corner's coordinate beyond noise, up to which boards are taken as flat and as "
            "printed",
            "twice the 0.11 px that plain boards of public stereo pairs leave beside Brown's distortion "
            "(docs/explanation/accuracy.md)",
        ),
    ] = 0.2
    lone_score_margin: Annotated[
        float,
        Rule(
            "significance",
            "score",
            "excess of the best score over the threshold that is a mismatch where neither a slice nor a refit shows one",  # noqa: E501
            TUNED,
            off=0.0,
        ),
    ] = 10.0

    # --- cost of a model ----------------------------------------------------------------------------------------------
    parameter_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "gain in log-likelihood that a fitted parameter has to earn",
            "BIC, 0.5 ln n: 2.5 for n = 150 independent numbers, 2.9 for 300",
        ),
    ] = 2.5
    included_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "prior log odds against a listed effect being there",
            "ln 45: one of the library's effects a camera",
        ),
    ] = 3.8
    dispensable_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "gain that a parameter declared dispensable has to earn besides",
            "about half of a usual threshold (15 to 18 in chi2), as a further effect has to",
        ),
    ] = 8.0
    discrepancy_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "gain that a model discrepancy has to earn",
            "logarithm of the number of kernels that differ: 20 amplitudes x 3 lengths x 4 groupings = 240 are tried, "
            "of which neighbouring amplitudes are nearly alike: about 150",
        ),
    ] = 5.0
    exchange_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "gain from which on leaving out or exchanging a member counts as better",
            "what refits of the same set from different starts differ by",
        ),
    ] = 0.5
    least_tolerated_share: Annotated[
        float,
        Rule(
            "cost of a model",
            "1",
            "least share of the laws' form tolerances by which sets of effects are compared, each by its likeliest",
            "a tenth of a declared tolerance is below the noise up to changes of 200 standard deviations (5 %); 1 "
            "takes the declared ones as they are",
        ),
    ] = 0.1
    beside_tolerance: Annotated[
        float,
        Rule(
            "cost of a model",
            "1",
            "least share of its own change by which any law may be wrong where a further effect beside it is weighed",
            "chosen: 0.5 % of the transfer, as lenses depart from any law, of a filter that takes a quarter of it",
        ),
    ] = 0.02
    misstated_ratio: Annotated[
        float,
        Rule(
            "cost of a model",
            "1",
            "factor from which on a fitted f-number or pitch counts as another one than stated",
            "f-numbers are marked in thirds of a stop, a factor of 1.12",
        ),
    ] = 1.1
    sure_misstated_log_odds: Annotated[
        float,
        Rule(
            "cost of a model",
            "log odds",
            "gain of a misstated f-number or pitch from which on rivals aren't weighed",
            "a probability of exp(-30) changes no decision",
        ),
    ] = 30.0

    # --- name ---------------------------------------------------------------------------------------------------------
    least_probability: Annotated[float, Rule("name", "1", "least probability of a name", "likelier than not")] = 0.5
    least_inclusion_probability: Annotated[
        float,
        Rule(
            "name",
            "1",
            "least probability that a named effect is there, against the same set without it and with "
            "`included_log_odds` as its prior",
            "odds of 9 to 1; with `parameter_log_odds`, one parameter has to gain 17 in chi2, which noise reaches in "
            "one of 27 000 effects that are tried",
        ),
    ] = 0.9
    least_size_sigma: Annotated[
        float,
        Rule(
            "name",
            "standard deviations",
            "distance from absence that at least one parameter which sizes a named effect has",
            "95 % of a normal distribution: what is within it isn't told as a size",
        ),
    ] = 2.0
    least_means_log_odds: Annotated[
        float,
        Rule(
            "name",
            "log odds",
            "least gain in log-likelihood, in the numbers that aren't variances, of an effect that changes variances "
            "by changing the mean response",
            "ln(1 / `false_alarm_rate`): without the effect, a likelihood ratio exceeds 1 / p with a probability of p "
            "at most (Markov)",
        ),
    ] = 4.6
    family_probability: Annotated[
        float,
        Rule(
            "name",
            "1",
            "least probability that a family's members hold together, if the cause is a listed effect; and below "
            "which its likeliest member isn't named beside others of the family that fit",
            "odds of 4 to 1, chosen",
        ),
    ] = 0.8
    family_least_share: Annotated[
        float,
        Rule(
            "name",
            "1",
            "least share of the excess chi2, in the measurements that its nearest law acts on, that a family of which "
            "no law holds explains",
            "a straight line explains three quarters of a step, so that a difference between taps would be uneven "
            "light by less",
        ),
    ] = 0.76
    least_explained_share: Annotated[
        float,
        Rule(
            "name",
            "1",
            "least share of the excess chi2, in the measurements that an effect acts on, that its name explains",
            TUNED,
            off=0.0,
        ),
    ] = 0.8
    least_explained_share_open: Annotated[
        float,
        Rule(
            "name",
            "1",
            "the same where what is left exceeds noise and form tolerances",
            "a filter beside a ripple without a law is no vibration of 96 % "
            "(`tests/lab/diagnose/inference/test_decide.py`); " + TUNED,
            off=0.8,
        ),
    ] = 0.98
    near_share: Annotated[
        float,
        Rule(
            "name",
            "1",
            "least share of the excess chi2 of a measurement that a law explains which is told as the nearest",
            "chosen: it explains more than it leaves",
        ),
    ] = 0.5
    noise_sigma: Annotated[
        float,
        Rule(
            "name",
            "standard deviations",
            "excess of chi2 over its expectation up to which what is left counts as noise",
            "one-sided 99.9 % of a normal distribution",
        ),
    ] = 3.0
    remainder_log_odds: Annotated[
        float, Rule("name", "log odds", "gain of a discrepancy that never speaks against a name", "odds of 20 to 1")
    ] = 3.0
    remainder_share: Annotated[
        float,
        Rule(
            "name",
            "1",
            "gain of a discrepancy in the measurement that shows a name most, over the name's gain, above which both "
            "count as one unknown cause",
            "chosen: 2 % may be left",
        ),
    ] = 0.02
    equal_mode_log_odds: Annotated[
        float,
        Rule(
            "name",
            "log odds",
            "difference within which two modes of a parameter, both signs for one, count as equally likely",
            "a likelihood ratio of two standard deviations: 2^2 / 2",
        ),
    ] = 2.0

    # --- budget of the search -----------------------------------------------------------------------------------------
    most_effects: Annotated[
        int, Rule("budget of the search", "1", "effects in one set", "chosen: twice what the proof's compounds have")
    ] = 4
    refitted_sets: Annotated[
        int,
        Rule(
            "budget of the search",
            "1",
            "sets refitted in one step, and rivals of one name, the best in closed form",
            "chosen: all sets of that size are compared in closed form before",
        ),
    ] = 10
    refitted_pairs: Annotated[
        int,
        Rule(
            "budget of the search",
            "1",
            "pairs refitted in the place of one effect, or beside a set, where no single effect betters it",
            "chosen: half of `refitted_sets`, as they come last",
        ),
    ] = 5
    promised_share: Annotated[
        float,
        Rule(
            "budget of the search",
            "1",
            "share of a name's gain that an effect promises in closed form, from which on it is fitted in its place; "
            "and of the best score beside a set, from which on an effect is added",
            "a refit of a large effect may gain two and a half times what its small signature promises; " + TUNED,
            off=0.0,
        ),
    ] = 0.4
    search_cpu_s: Annotated[
        float,
        Rule(
            "budget of the search",
            "s",
            "CPU time of one side's search after which no further set is refitted, and no rival; these are listed",
            "chosen: the challenge's limit for a whole diagnosis",
        ),
    ] = 120.0
    rival_cosine: Annotated[
        float,
        Rule(
            "budget of the search",
            "1",
            "cosine of two whitened signatures from which on two effects are rivals",
            "at a non-centrality of 25 (detected in 93 % of cases) rivals are told apart in less than 95 %: "
            "Phi(0.5 sqrt(25 (1 - 0.75^2))) = 0.951",
        ),
    ] = 0.75
    certain_probability: Annotated[
        float,
        Rule(
            "budget of the search",
            "1",
            "probability from which on a name isn't weighed again when another member changes",
            "`false_alarm_rate` for wrong names",
        ),
    ] = 0.99
    hopeless_log_odds: Annotated[
        float,
        Rule(
            "budget of the search",
            "log odds",
            "distance of a rival that no discrepancy beside it makes up for",
            "a probability of exp(-30) changes no decision",
        ),
    ] = 30.0
    # --- model discrepancy --------------------------------------------------------------------------------------------
    left_out_parts: Annotated[
        int,
        Rule(
            "model discrepancy",
            "1",
            "parts of a measurement's captures that are left out in turn",
            "chosen: 6-fold cross-validation",
        ),
    ] = 6
    equal_discrepancy_log_odds: Annotated[
        float,
        Rule(
            "model discrepancy",
            "log odds",
            "difference within which cross-validation decides between kernels where repeats are held out",
            "twice `discrepancy_log_odds`",
        ),
    ] = 10.0
    repeat_distance: Annotated[
        float,
        Rule(
            "model discrepancy",
            "correlation lengths",
            "distance within which two numbers of one channel and condition are repeats",
            "a squared exponential's correlation is 0.995 there",
        ),
    ] = 0.1

    # --- report -------------------------------------------------------------------------------------------------------
    shown_chi2: Annotated[
        float,
        Rule(
            "report",
            "1",
            "chi2 of an effect's change from which on a measurement is said to show it",
            "five standard deviations",
        ),
    ] = 25.0
    shown_share: Annotated[float, Rule("report", "1", "its least share of the strongest measurement's", "chosen")] = (
        0.02
    )
    detection_probability: Annotated[
        float, Rule("report", "1", "probability at which the smallest detectable size is stated", "chosen")
    ] = 0.9
    least_rival_probability: Annotated[
        float,
        Rule(
            "report",
            "1",
            "least probability of a rival that is listed",
            "half of `false_alarm_rate`; rival sets' coverage: `calibench challenge score`",
        ),
    ] = 0.005
    model_set_share: Annotated[
        float,
        Rule(
            "report",
            "1",
            "probability that the listed sets of effects hold together",
            "chosen; tests on linear problems: such sets hold the truth as often",
        ),
    ] = 0.95
    next_capture_share: Annotated[
        float,
        Rule(
            "report", "1", "probability that the rivals which a next capture is to tell apart hold together", "chosen"
        ),
    ] = 0.9
    next_capture_rivals: Annotated[
        int, Rule("report", "1", "how many these are at most", "chosen: each is refitted")
    ] = 4
    next_capture_distance: Annotated[
        float,
        Rule(
            "report",
            "1",
            "D = 1/2 |m_k - m_l|^2 from which on a capture is worth taking",
            "decides rightly with probability Phi(sqrt(D / 2)) = 0.84",
        ),
    ] = 2.0
    next_captures_listed: Annotated[int, Rule("report", "1", "captures that are listed", "chosen")] = 5
    resolve_least_share: Annotated[
        float,
        Rule(
            "report",
            "1",
            "share of a doubt's entropy that a capture, or two together, must be expected to tell to be taken",
            "rivals `next_capture_distance` apart are told to 0.32 of their entropy at equal odds, to 0.21 at 19 to 1",
        ),
    ] = 0.2

    @classmethod
    def rules(cls) -> dict[str, Rule]:
        """Return the declaration of every field, in order."""
        hints = get_type_hints(cls, include_extras=True)
        return {name: next(m for m in get_args(hints[name]) if isinstance(m, Rule)) for name in cls.model_fields}

    def told(self) -> tuple[PolicyRule, ...]:
        """Every field with its value, as a result states it."""
        return tuple(
            PolicyRule(name=name, group=rule.group, value=getattr(self, name), unit=rule.unit, meaning=rule.meaning)
            for name, rule in self.rules().items()
        )
