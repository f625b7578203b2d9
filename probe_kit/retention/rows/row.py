"""One row per run, category and view: behaviour, probes and retention side by side."""

from dataclasses import dataclass, field
from typing import Literal, Self

from probe_kit._tables.numbers import Limits
from probe_kit.hooks.contract.sites import first_of, label_of
from probe_kit.intervene.verdict import UseVerdict
from probe_kit.retention.behaviour import OutcomeRuleScores, SuccessRate, TableRun
from probe_kit.runs.reader import full_name
from probe_kit.statistics.sufficiency import Verdict
from probe_kit.train.choices import CORRECT, SIDES, Task
from probe_kit.train.crossval.task_scores import METRICS
from probe_kit.train.results.control_scores import has_signal, missed_controls
from probe_kit.train.results.probe_results import ProbeResults

Mode = Literal["answers", "acts"]
"""The task of a run's model: it answers questions about pictures (a VLM run), or acts (a policy run)."""


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """The run that the numbers of a row are of.

    Attributes:
        location: Folder or URL.
        settings: The sha256 of the run's settings.
        probes: Key of its probe results.
        label: Name of the run in tables and legends.
        action_stream: `expert`, or `action` in a policy without one, whose iterations are action tokens.
        call: The captured inference that was probed, from 0.
        capture_only: Whether activations were captured and the model did not act.
    """

    location: str
    model: str
    random_weights: bool
    weights_sha256: str | None
    suite: str
    settings: str
    probes: str | None
    mode: Mode = "acts"
    label: str = ""
    action_stream: str | None = None
    call: int | None = None
    capture_only: bool = False

    @classmethod
    def of(cls, table_run: TableRun, results: ProbeResults | None) -> Self:
        """Return the part of a row that names its run."""
        run = table_run.run
        return cls(
            location=table_run.location,
            model=run.model,
            label=table_run.label,
            random_weights=run.random_weights,
            weights_sha256=run.weights_sha256,
            suite=run.suite,
            mode="answers" if table_run.answers else "acts",
            action_stream=first_of("action", run.streams.values()),
            settings=run.settings_sha256,
            probes=None if results is None else results.key,
            call=None if results is None else results.settings.call,
            capture_only=table_run.is_captured_only,
        )

    @property
    def name(self) -> str:
        """The label, marked if the weights are random or the model did not act."""
        return full_name(self.label or self.model, self.random_weights, self.capture_only)

    @property
    def action_name(self) -> str:
        """The name of `action_stream` in a sentence."""
        return label_of(self.action_stream or "expert")


@dataclass(frozen=True, kw_only=True)
class AnswerStats:
    """The prompt of a VLM run, and further numbers of its answers; all None for a policy run.

    `share_by_clause` and `accuracy_strict` are None for runs that do not store them.

    Attributes:
        asked_for: `target`, `distractor` or `absent`.
        score: The score by which `success.sr` is judged.
        accuracy_text: Share that is right by text.
        accuracy_logits: Share that is right by logits.
        accuracy_order_balanced: Share that is right by logits averaged over both orders of the options.
        share_unparsable: Share of answers in text that could not be parsed.
        share_by_clause: Share of answers that were found among other words.
        accuracy_strict: The accuracy by text with these as unparsable, where they are many.
        option_mass: Mean probability of the admissible answers together.
        letter_bias: Mean logit by which the option named first is preferred.
        share_near_tie: Share of choices that rounding may have made.
    """

    prompt: str | None = None
    picture: str | None = None
    picture_size: str | None = None
    asked_for: str | None = None
    score: str | None = None
    accuracy_text: float | None = None
    accuracy_logits: float | None = None
    accuracy_order_balanced: float | None = None
    share_unparsable: float | None = None
    share_by_clause: float | None = None
    accuracy_strict: float | None = None
    option_mass: float | None = None
    letter_bias: float | None = None
    share_near_tie: float | None = None


@dataclass(frozen=True, kw_only=True)
class SwapEffect:
    """Effect of exchanging the two pictures, if `probe-kit intervene` was run.

    Attributes:
        follow_rate: Share of episodes in which the action goes to the correct picture, and to the other side once
            the two are swapped.
        reversal_rate: Share of episodes in which it does the reverse.
        net_follow_rate: Difference of the two shares.
        reach_share: Displacement toward the correct picture in units of the policy's reach.
        follow_p: Exact, one-sided; see `intervene.ImageSwapEffect`.
        use: The verdict from this effect, the row's own probes and stored interchanges.
    """

    follow_rate: float | None = None
    reversal_rate: float | None = None
    net_follow_rate: float | None = None
    net_follow_rate_ci: Limits | None = None
    reach_share: float | None = None
    reach_share_ci: Limits | None = None
    follow_p: float | None = None
    use: UseVerdict | None = None

    @property
    def is_used(self) -> bool:
        """Whether the verdict is *used*, wholly and toward the correct picture."""
        return self.use is not None and self.use.behaviour == "used" and not self.use.reversed

    @property
    def explanation(self) -> str:
        """The evidence of the verdict; empty without one."""
        return "" if self.use is None else self.use.explanation


@dataclass(frozen=True, kw_only=True)
class StreamPart:
    """The scores of probes of one stream.

    Of a target that is no side, peak is the metric of the site with the largest score above its own chance. Its
    chance is the mean score of the label permutations there. Score, verdict, at_most, selectivity and
    minus_untrained are of sides alone.

    Attributes:
        score: Accuracy of the sites that the inner folds choose, on the outer folds; balanced between the sides,
            so that chance is one half.
        ci: The 95 % interval of `score`.
        peak: Accuracy of the site that is best on all groups, which is too high by the luck of being chosen.
        above: Score above chance of the sites that the inner folds choose, on the outer folds.
        above_ci: The 95 % interval of `above`, Student's.
        at_most: An upper 95 % limit of the best site's accuracy.
        verdict: `shown` (family-wise above chance, and above every control that was run), `absent` (not shown,
            `at_most` below a bound, and the bound findable by so many items), or `not shown`.
        site: The first of the best sites, a place without an interval of its own.
        layer: Layer of that site.
        depth: Depth of that site as a fraction.
        ties: Number of other sites that are as accurate.
        p_fwe: Family-wise p of that site.
        exceeds: Whether it is better than `chance` and each control; None for one that was not run.
        selectivity: Its accuracy above that of the same probe on random labels of whole groups.
        minus_untrained: Its accuracy minus that of the untrained network's best site.
        remedy: What to do where no p can be below 0.05, such as more permutations or groups; empty where one can.
    """

    stream: str | None = None
    score: float | None = None
    ci: Limits | None = None
    peak: float | None = None
    chance: float | None = None
    above: float | None = None
    above_ci: Limits | None = None
    at_most: float | None = None
    verdict: Verdict | None = None
    site: str | None = None
    layer: int | None = None
    depth: float | None = None
    ties: int | None = None
    p_fwe: float | None = None
    exceeds: dict[str, bool | None] = field(default_factory=dict)
    selectivity: float | None = None
    minus_untrained: float | None = None
    minus_untrained_ci: Limits | None = None
    remedy: str = ""

    @property
    def has_signal(self) -> bool:
        """Whether it is better than chance and than every control that was run."""
        return bool(self.exceeds) and has_signal(self.exceeds)

    @property
    def is_controlled(self) -> bool:
        """Whether its best site was compared with a control, and not with chance alone."""
        return any(better is not None for name, better in self.exceeds.items() if name != "chance")

    @property
    def missed(self) -> tuple[str, ...]:
        """The names of chance and controls that its best site is not shown to exceed."""
        return missed_controls(self.exceeds)


@dataclass(frozen=True, kw_only=True)
class BackbonePart(StreamPart):
    """The scores of probes of the backbone; see `StreamPart`."""


@dataclass(frozen=True, kw_only=True)
class ActionPart(StreamPart):
    """The scores of probes where the action is made; see `StreamPart`.

    The three attributes are None where the stream runs once; `first_peak` and `first_layer` also for a target that
    is no side.

    Attributes:
        iteration: The flow-matching step or action token of the site.
        first_peak: Accuracy of the best layer at the first iteration, which has seen no action.
        first_layer: The best layer at the first iteration.
    """

    iteration: int | None = None
    first_peak: float | None = None
    first_layer: int | None = None


@dataclass(frozen=True, kw_only=True)
class RetentionPart:
    """Share of the backbone's signal that can be read where the action is made.

    Attributes:
        value: Score of the action above one half over that of the backbone; in a mean the ratio of the mean scores
            of all probed categories.
        ci: Its 95 % interval, (None, None) where the backbone is not known well enough to divide by.
        published: The ratio of the peaks; in a mean the mean of these ratios over the categories whose backbone
            signal is shown; of sides alone.
        defined: Whether the backbone's signal is shown, in a mean in any category.
        note: Reason why it is not defined, in few words.
        reason: Of a target that is no side, the same reason with the finding, the expectation and the remedy.
    """

    value: float | None = None
    ci: Limits | None = None
    published: float | None = None
    defined: bool = False
    note: str = "n/a (no probes)"
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class ControlScores:
    """The scores that those of probes are compared with.

    Attributes:
        n_groups: Independent groups of items.
        n_samples: Episodes, or inferences of them, that were probed.
        missing: By side, the share of items without their episode of that side.
        probe_minus_sr: Backbone score − success rate.
        baselines: Accuracy of each control that never sees the model.
        leaks: Names of those above chance.
        untrained: Name of the untrained network's run.
    """

    n_groups: int | None = None
    n_samples: int | None = None
    missing: dict[str, float] = field(default_factory=dict)
    probe_minus_sr: float | None = None
    baselines: dict[str, float] = field(default_factory=dict)
    leaks: tuple[str, ...] = ()
    untrained: str | None = None


MEAN = "mean"
"""Category of the rows that average over categories."""


@dataclass(frozen=True, kw_only=True)
class RetentionRow:
    """One row of the retention table: its parts. A part without values holds defaults.

    In a row of category `mean`, numbers are averages over `categories`. The published definition of retention,
    which divides by each category's own backbone, leaves out `left_out`.

    Attributes:
        view: The vectors that were probed: how tokens became one, or `tokens` for each by itself. None without
            probes.
        target: The target that the probes decode.
        task: Kind of the target.
        group: Of several groups of runs, this run's.
    """

    category: str
    view: str | None
    target: str = CORRECT
    task: Task = "binary"
    group: str | None = None
    categories: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    run: RunInfo
    success: SuccessRate
    rules: OutcomeRuleScores = field(default_factory=OutcomeRuleScores)
    answers: AnswerStats = field(default_factory=AnswerStats)
    backbone: BackbonePart = field(default_factory=BackbonePart)
    action: ActionPart = field(default_factory=ActionPart)
    retention: RetentionPart = field(default_factory=RetentionPart)
    controls: ControlScores = field(default_factory=ControlScores)
    image_swap: SwapEffect = field(default_factory=SwapEffect)

    @property
    def key(self) -> tuple[str | None, str]:
        """Group and location of its run, which distinguish the runs of a table."""
        return self.group, self.run.location

    @property
    def label(self) -> str:
        """The label that is decoded; empty where it is the answer's side, whose rows alone have success rates."""
        return "" if self.target in SIDES else self.target

    @property
    def metric(self) -> str:
        """The name of the score: accuracy balanced between classes, or R²."""
        return METRICS[self.task]
