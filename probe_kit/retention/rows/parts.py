"""What a row of the retention table is put together from; None where there is nothing to say.

Shares and accuracies run from 0 to 1, depths from 0 to 1 of the stream. Names are those of the JSON keys.
"""

from dataclasses import dataclass, field

from probe_kit.retention.estimators.bootstrap_draws import Limits


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """Whose numbers a row holds.

    label: what the run is called in tables and legends. action_stream: `expert`, or `action` in a policy without
    one, whose iterations are action tokens. call: the captured inference that was probed, from 0. listened: the
    model was only heard and did not act.
    """

    run: str
    model: str
    random_weights: bool
    weights_sha256: str | None
    suite: str
    run_settings: str
    probe_settings: str | None
    label: str = ""
    action_stream: str | None = None
    call: int | None = None
    listened: bool = False


@dataclass(frozen=True, kw_only=True)
class Behaviour:
    """What the policy did; `sr` is None where it was listened to and did not act.

    chance_margin_episodes, chance_margin_items, chance_margin: Δ over episodes (the paper's), over items, and over as many items as count,
    which decides `regime`. sr_by_epsilon: SR by zone radius in metres. sr and all that follows from it is None
    where the outcome rule needs trajectories that the run does not keep.
    """

    n_episodes: int
    n_items: int
    sr: float | None
    chance_margin_episodes: float | None = None
    chance_margin_items: float | None = None
    chance_margin: float | None = None
    sr_ci: Limits | None = None
    sr_original: float | None = None
    sr_swapped: float | None = None
    sr_left: float | None = None
    sr_right: float | None = None
    share_wrong: float | None = None
    share_outside: float | None = None
    share_never_moved: float | None = None
    share_invalid_action: float | None = None
    regime: str | None = None
    regime_reason: str | None = None
    side_preference: float | None = None
    items_both_right: int | None = None
    items_one_right: int | None = None
    items_none_right: int | None = None
    paired_p: float | None = None
    normalised_score: float | None = None
    sr_by_epsilon: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class AnswerStats:
    """How a run was asked and what else its answers say; `kind` is `acts` for a run that was not.

    asked_for: `target`, `distractor` or `absent`. score: by which of its scores `sr` is. accuracy_text,
    accuracy_logits, accuracy_order_balanced: shares that are right by each score. share_unparsable: answers in text that
    could not be read. option_mass: mean probability of the admissible answers together. letter_bias: mean
    logit by which the option named first is preferred. share_near_tie: choices that rounding may have made.
    """

    kind: str = "acts"
    prompt: str | None = None
    picture: str | None = None
    picture_size: str | None = None
    asked_for: str | None = None
    score: str | None = None
    accuracy_text: float | None = None
    accuracy_logits: float | None = None
    accuracy_order_balanced: float | None = None
    share_unparsable: float | None = None
    option_mass: float | None = None
    letter_bias: float | None = None
    share_near_tie: float | None = None


@dataclass(frozen=True, kw_only=True)
class SwapEffect:
    """What the exchange of the two pictures did, if `probe-kit intervene` was run; see `intervene.Following`.

    follows, against: shares of episodes; follows_net: their difference, follows_p: exact, one-sided. used: the
    verdict of that and the row's own probes; used_note: what it rests on, or why there is none.
    """

    follows: float | None = None
    against: float | None = None
    follows_net: float | None = None
    follows_net_ci: Limits | None = None
    follows_p: float | None = None
    used: str | None = None
    used_note: str = ""


@dataclass(frozen=True, kw_only=True)
class BackbonePeak:
    """The backbone's best site, the first one on ties.

    backbone_ties: how many other sites are as accurate. backbone_selectivity: its accuracy above that of the same
    probe on random labels of items. backbone_exceeds: whether it is better than `chance`, `binding` and `untrained`,
    family-wise; None for a control that was not run. backbone_minus_untrained: how much more accurate it is than `untrained`'s.
    """

    backbone_accuracy: float | None = None
    backbone_ci: Limits | None = None
    backbone_layer: int | None = None
    backbone_depth: float | None = None
    backbone_p_fwe: float | None = None
    backbone_selectivity: float | None = None
    backbone_exceeds: dict[str, bool | None] = field(default_factory=dict)
    backbone_minus_untrained: float | None = None
    backbone_minus_untrained_ci: Limits | None = None
    backbone_ties: int | None = None


@dataclass(frozen=True, kw_only=True)
class ActionPeak:
    """The best site where the action is made; fields as of `BackbonePeak`.

    action_first_accuracy, action_first_layer: the best layer at the first iteration, which has seen no
    action; None where the stream runs once.
    """

    action_accuracy: float | None = None
    action_ci: Limits | None = None
    action_layer: int | None = None
    action_depth: float | None = None
    action_iteration: int | None = None
    action_p_fwe: float | None = None
    action_selectivity: float | None = None
    action_exceeds: dict[str, bool | None] = field(default_factory=dict)
    action_minus_untrained: float | None = None
    action_minus_untrained_ci: Limits | None = None
    action_first_accuracy: float | None = None
    action_first_layer: int | None = None
    action_ties: int | None = None


@dataclass(frozen=True, kw_only=True)
class RetentionScores:
    """How much of the backbone's signal reaches the action.

    `retention` is the published ratio even when `retention_defined` is False, and then no category mean contains
    it. `retention_ci` is the 95 % interval of `retention_debiased`, (None, None) when the data set no limit;
    `retention_bounded` lies between that and the peaks, `retention_area` is the ratio of means over all sites.
    """

    retention: float | None = None
    retention_defined: bool = False
    retention_note: str = "n/a (no probes)"
    retention_debiased: float | None = None
    retention_ci: Limits | None = None
    retention_bounded: float | None = None
    retention_bounded_ci: Limits | None = None
    retention_area: float | None = None
    retention_area_ci: Limits | None = None


@dataclass(frozen=True, kw_only=True)
class ControlScores:
    """What the probes are held against.

    chance: accuracy of always naming the larger class. baselines: accuracy of each control that never sees the
    model; leaks: those above chance. gap: prefix accuracy − SR. untrained: the run of random weights beside this one.
    """

    n_groups: int | None = None
    chance: float | None = None
    gap: float | None = None
    baselines: dict[str, float] = field(default_factory=dict)
    leaks: tuple[str, ...] = ()
    untrained: str | None = None
