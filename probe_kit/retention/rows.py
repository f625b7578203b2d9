"""One row per run, category and view: behaviour, probes and retention side by side."""

from dataclasses import dataclass, field

from probe_kit.hooks.sites import label_of
from probe_kit.train.controls import signal

MEAN = "mean"
"""Category of the rows that average over categories."""


@dataclass(frozen=True)
class RetentionRow:
    """One line of the retention table; None where there is nothing to say.

    Shares and accuracies run from 0 to 1, depths from 0 to 1 of the stream. `retention` is the published ratio
    even when `retention_defined` is False, and then no category mean contains it. `retention_ci` is the 95 %
    interval of `retention_debiased`, (None, None) when the data set no limit; `retention_bounded` lies between
    that and the peaks, `retention_area` is the ratio of means over all sites. `gap` = prefix accuracy − SR.
    label: what the run is called in tables and legends.
    sr_by_epsilon: SR by zone radius in metres. prefix_selectivity, action_selectivity: accuracy of the best site
    above that of the same probe on random labels of items. baselines: accuracy of each control that never sees the
    model; leaks: those above chance.
    delta, delta_items, delta_regime: Δ over episodes (the paper's), over items, and over as many items as count,
    which decides `regime`.
    prefix_beats, action_beats: whether the best site is better than `chance`, `binding` and `twin`, family-wise;
    None for a control that was not run.
    action_first_accuracy, action_first_layer: the best layer at the first iteration, which sees pure noise; None
    where the stream runs once. call: the captured inference that was probed, from 0.
    prefix_twin, action_twin: how much more accurate the best site is than that of `twin`.
    action_stream: `expert`, or `action` in a policy without one, whose iterations are action tokens.
    In a row of category `mean`, numbers are averages over `categories` and retention leaves out `left_out`.
    """

    run: str
    model: str
    random_weights: bool
    weights_sha256: str | None
    suite: str
    run_settings: str
    probe_settings: str | None
    category: str
    view: str | None
    n_episodes: int
    n_items: int
    sr: float
    delta: float | None = None
    delta_items: float | None = None
    sr_ci: tuple[float | None, float | None] | None = None
    sr_original: float | None = None
    sr_swapped: float | None = None
    sr_left: float | None = None
    sr_right: float | None = None
    p_wrong: float | None = None
    p_oob: float | None = None
    p_never_moved: float | None = None
    p_flagged: float | None = None
    regime: str | None = None
    regime_reason: str | None = None
    side_preference: float | None = None
    items_both_right: int | None = None
    items_one_right: int | None = None
    items_none_right: int | None = None
    paired_p: float | None = None
    normalised_score: float | None = None
    n_groups: int | None = None
    chance: float | None = None
    prefix_accuracy: float | None = None
    prefix_layer: int | None = None
    prefix_depth: float | None = None
    prefix_p_fwe: float | None = None
    action_stream: str | None = None
    action_accuracy: float | None = None
    action_layer: int | None = None
    action_depth: float | None = None
    action_iteration: int | None = None
    action_p_fwe: float | None = None
    retention: float | None = None
    retention_defined: bool = False
    retention_note: str = "n/a (no probes)"
    retention_debiased: float | None = None
    retention_ci: tuple[float | None, float | None] | None = None
    gap: float | None = None
    prefix_ci: tuple[float | None, float | None] | None = None
    action_ci: tuple[float | None, float | None] | None = None
    prefix_selectivity: float | None = None
    action_selectivity: float | None = None
    sr_by_epsilon: dict[str, float] = field(default_factory=dict)
    baselines: dict[str, float] = field(default_factory=dict)
    leaks: tuple[str, ...] = ()
    twin: str | None = None
    prefix_twin: float | None = None
    prefix_twin_ci: tuple[float, float] | None = None
    action_twin: float | None = None
    action_twin_ci: tuple[float, float] | None = None
    label: str = ""
    group: str | None = None
    categories: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    prefix_beats: dict[str, bool | None] = field(default_factory=dict)
    action_beats: dict[str, bool | None] = field(default_factory=dict)
    delta_regime: float | None = None
    retention_bounded: float | None = None
    retention_bounded_ci: tuple[float | None, float | None] | None = None
    retention_area: float | None = None
    retention_area_ci: tuple[float | None, float | None] | None = None
    action_first_accuracy: float | None = None
    action_first_layer: int | None = None
    call: int | None = None

    @property
    def prefix_signal(self) -> bool:
        """Whether the backbone knows the answer: better than chance and every control that was run."""
        return bool(self.prefix_beats) and signal(self.prefix_beats)

    @property
    def action_signal(self) -> bool:
        """The same of the stream the action is made in."""
        return bool(self.action_beats) and signal(self.action_beats)

    @property
    def action_name(self) -> str:
        """What `action_stream` is called in a sentence."""
        return label_of(self.action_stream or "expert")
