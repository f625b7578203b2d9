"""The rows of one run, with the estimates that averages and differences are made of."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from probe_kit.env.scoring.rules import DEFAULT_RULE
from probe_kit.errors import UnknownSiteError
from probe_kit.hooks.contract.sites import first_of
from probe_kit.intervene.kinds.image_swap import ImageSwapEffect, stored_image_swaps
from probe_kit.intervene.results.evidence import StoredEvidence, stored_other_readouts, stored_places, stored_ties
from probe_kit.intervene.results.verdict import Places, UseVerdict, classify_use, control_for
from probe_kit.retention.behaviour.success_rate import (
    SuccessRate,
    capture_only,
    sensitivity,
    success_rate,
    success_share,
    units_of,
)
from probe_kit.retention.behaviour.vlm_answers import ask_of, read_by_clause
from probe_kit.retention.choices import Iterations
from probe_kit.retention.estimators.stream_scores import RowEstimates
from probe_kit.retention.rows.outcome_rules import OutcomeRuleScores, RunUnderRule
from probe_kit.retention.rows.parts import AnswerStats, RunInfo, SwapEffect
from probe_kit.retention.rows.probe_parts import number_or_none, with_probes
from probe_kit.retention.rows.row import RetentionRow
from probe_kit.runs.reader import RunReader
from probe_kit.statistics.estimates.verdict import ABSENT_BELOW
from probe_kit.train.choices import CORRECT
from probe_kit.train.results.probe_results import ProbeResults

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class RowWithEstimates:
    """A row and the estimates behind its numbers. outcomes: the episodes of its success rate, if it has one."""

    row: RetentionRow
    estimates: RowEstimates
    outcomes: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class RowSettings:
    """The settings of a table.

    epsilons: zone radii in metres for `sr_by_epsilon`, which belong to the rule `disc`. rule, last_steps: see
    `probe_kit.env.scoring.rules.judge`. absent_below: accuracy below which a stream's best site counts as absent.
    with_behaviour: see `RunUnderRule.of`.
    """

    views: Sequence[str] | None
    iterations: Iterations
    epsilons: Sequence[float]
    rule: str = DEFAULT_RULE
    last_steps: int = 1
    absent_below: float = ABSENT_BELOW
    categories: Sequence[str] | None = None
    with_behaviour: bool = True


def run_rows(
    run: RunReader, results: ProbeResults | None, settings: RowSettings, group: str | None = None
) -> list[RowWithEstimates]:
    """One row per category and view of `run`, in the order of its episodes; without `results`, success rates only.

    Raises UnknownSiteError for a view that was not probed.
    """
    views: Sequence[str | None] = (None,) if results is None else settings.views or results.settings.views
    if results is not None and (unknown := set(settings.views or ()) - set(results.settings.views)):
        probed = ", ".join(results.settings.views)
        raise UnknownSiteError(f"{run.location} has probes of {probed}, not of {', '.join(sorted(unknown))}")
    judged = RunUnderRule.of(run, settings.rule, settings.last_steps, settings.with_behaviour)
    effects = stored_image_swaps(run)
    evidence = StoredEvidence(run)
    places = stored_places(evidence) if effects else {}
    readouts = stored_other_readouts(run, effects)
    ties = {view: stored_ties(evidence, results, view) if effects else {} for view in views}
    drawn = [
        _row(judged, results, settings, group, str(category), episodes, view)
        for category, episodes in judged.run.episodes.groupby("category", sort=False)
        if settings.categories is None or category in settings.categories
        for view in views
    ]
    return [
        replace(
            row,
            row=add_image_swap(
                row.row,
                effects,
                places,
                ties[row.row.view].get(row.row.category, ""),
                readouts.get(row.row.category),
            ),
        )
        for row in drawn
    ]


def _row(
    judged: RunUnderRule,
    results: ProbeResults | None,
    settings: RowSettings,
    group: str | None,
    category: str,
    episodes: "pd.DataFrame",
    view: str | None,
) -> RowWithEstimates:
    run, heard = judged.run, capture_only(episodes)
    scored = judged.scored and not heard
    success = success_rate(episodes) if scored else _no_success(episodes, heard)
    rules = OutcomeRuleScores(rule=judged.rule, rule_words=judged.words)
    estimates = RowEstimates()
    if scored:
        radii = settings.epsilons if settings.rule == DEFAULT_RULE else ()
        by_radius = {f"{radius:g}": rate for radius, rate in sensitivity(episodes, radii).items()}
        rules = replace(judged.part(episodes), sr_by_epsilon=by_radius)
        estimates = RowEstimates({"sr": success_share(episodes, run.seed_text), **judged.shares(episodes)})
    row = RetentionRow(
        category=category,
        view=view,
        target=CORRECT if results is None else results.settings.target,
        group=group,
        run=run_info(run, results),
        success=success,
        rules=rules,
        answers=_answers(run, episodes),
    )
    if results is not None and view is not None:
        row, streams = with_probes(row, results, settings.iterations, settings.absent_below, run.seed_text)
        estimates = replace(estimates, streams=streams)
    return RowWithEstimates(row, estimates, episodes if scored else None)


def add_image_swap(
    row: RetentionRow,
    effects: Mapping[str, ImageSwapEffect],
    places: Mapping[str, Places],
    tie: str = "",
    other: UseVerdict | None = None,
) -> RetentionRow:
    """The row with the effect of the image swap on its category, judged by its own probes.

    effects: by category; may be empty. places: by category, where it passes and is read. tie: of the row's
    category and view, see `evidence.stored_ties`. other: the behaviour by the other readout, see
    `evidence.stored_other_readouts`.
    """
    of_category = effects.get(row.category)
    if of_category is None:
        return row
    encoded = row.backbone.has_signal if row.backbone.exceeds else None
    category, control = row.category, control_for(row.category, effects)
    use = classify_use(encoded, of_category, control, places.get(category), tie, other)
    effect = SwapEffect(
        follow_rate=of_category.follow_rate,
        reversal_rate=of_category.reversal_rate,
        net_follow_rate=of_category.net_follow_rate,
        net_follow_rate_ci=of_category.net_follow_rate_ci,
        reach_share=of_category.reach_share,
        reach_share_ci=of_category.reach_share_ci if isfinite(of_category.reach_share_ci[0]) else (None, None),
        follow_p=of_category.follow_p,
        use=use,
    )
    return replace(row, image_swap=effect)


def run_info(run: RunReader, results: ProbeResults | None) -> RunInfo:
    """Return the part of a row that names its run."""
    return RunInfo(
        location=str(run.location),
        model=run.model,
        label=run.label,
        random_weights=run.random_weights,
        weights_sha256=run.weights_sha256,
        suite=run.suite,
        mode="acts" if ask_of(run) is None else "answers",
        action_stream=first_of("action", run.streams.values()),
        settings=run.settings_sha256,
        probes=None if results is None else results.key,
        call=None if results is None else results.settings.call,
        capture_only=capture_only(run.episodes),
    )


def _answers(run: RunReader, episodes: "pd.DataFrame") -> AnswerStats:
    ask = ask_of(run)
    if ask is None:
        return AnswerStats()
    text = episodes["outcome_text" if "outcome_text" in episodes else "outcome"]
    bias = episodes["letter_bias"].astype(float).mean()
    by_clause, strict = read_by_clause(episodes, text)
    return AnswerStats(
        prompt=str(ask["prompt"]),
        picture=str(ask["picture"]),
        picture_size=str(ask["picture_size"]),
        asked_for=str(ask["object"]),
        score=run.score,
        accuracy_text=float((text == "correct").mean()),
        accuracy_logits=float((episodes["outcome_logits"] == "correct").mean()),
        accuracy_order_balanced=float((episodes["outcome_debiased"] == "correct").mean()),
        share_unparsable=float((text == "oob").mean()),
        share_by_clause=by_clause,
        accuracy_strict=strict,
        option_mass=float(episodes["option_mass"].mean()),
        letter_bias=number_or_none(float(bias)),
        share_near_tie=float(episodes["near_tie"].astype(bool).mean()),
    )


def _no_success(episodes: "pd.DataFrame", heard: bool) -> SuccessRate:
    """Return an empty rate, of a model that did not act or a run that keeps nothing to judge by."""
    reason = "" if heard else "n/a: the run keeps no trajectories, which this outcome rule needs"
    items, groups = int(episodes["item_id"].nunique()), np.unique(units_of(episodes)).size
    return SuccessRate(n_episodes=len(episodes), n_items=items, n_groups=groups, reason=reason)
