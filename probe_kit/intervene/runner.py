"""Running an intervention: replay what is missing, store it, and read the result."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import CaptureChangedActionError
from probe_kit.hooks.capturing.edits import LOG_FIELDS
from probe_kit.hooks.registry import get_family
from probe_kit.intervene.kinds.base import ConditionName, Intervention, Measurement
from probe_kit.intervene.kinds.image_swap import ImageSwap, tiles_apart
from probe_kit.intervene.kinds.interchange import Interchange
from probe_kit.intervene.outcomes import (
    DONOR,
    IMAGE_SWAP,
    PER_STEP,
    ConditionOutcomes,
    check_run_fits,
    has_sides,
    is_stored,
    key_of,
    save,
    settings_of,
)
from probe_kit.intervene.places import check_roles_have_tokens, resolve_sites, unread_places
from probe_kit.intervene.replay import Condition, ReplayBatch
from probe_kit.intervene.results import InterventionResult, effects_csv, load_effects
from probe_kit.intervene.rollout import evaluate_per_step
from probe_kit.intervene.sessions import (
    LoadPolicy,
    Progress,
    ReplaySession,
    ReplaySource,
    displacements_toward,
    open_session,
    sizes,
)
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.results import Pieces, tidy_bundle
from probe_kit.runs.run import Run
from probe_kit.statistics.sufficiency import groups_for_not_used

REDO = "the same `probe-kit intervene` then plays it again"


def run_intervention(
    run: Run,
    intervention: Intervention | None = None,
    source: ReplaySource | None = None,
    *,
    load: LoadPolicy | None = None,
    progress: Progress | None = None,
    on_fit_progress: Progress | None = None,
) -> InterventionResult:
    """Intervene on a run's policy and store the result with the run; a stored result is loaded.

    intervention: `ImageSwap()` by default. source: where policy and pictures are, by default the embedded suite
    and the model's own checkpoint. load: how the policy is found, if not by its name. progress: called after every
    item replayed; on_fit_progress: after every item inferred before that, where directions or erasers are fitted.
    What was interrupted is continued. Raises UsageError for a run whose policy did not act, UnknownCategoryError,
    and what `open_session` raises.
    """
    intervention = intervention or ImageSwap()
    check_run_fits(run)
    intervention.check_run(run)
    check_supported(run, intervention)
    settings = settings_of(intervention, run)
    key = key_of(settings)
    if is_stored(run.location, key):
        tidy_bundle(run.location, INTERVENTIONS, key)
        return load_effects(run, key)
    pieces = Pieces.of(run.location, INTERVENTIONS, key, run.stamp, REDO)
    requested, patterns = intervention.items_in(run), _patterns(settings)
    with open_session(run, source or ReplaySource(), load, intervention) as session, session.ready():
        policy = session.policy
        session.on_fit_progress = on_fit_progress or notebook_progress("items learnt from")
        _check_roles(session, settings, getattr(type(intervention), "roles", Interchange.roles))
        items = intervention.eligible_items(session, requested)
        conditions = intervention.conditions(session)
        progress = progress or notebook_progress("items replayed")
        batch = _replay_items(session, intervention, items, conditions, pieces, progress)
        extra_files = intervention.extra_files(session, conditions, batch)
        certificate = {
            "policy": policy.card.to_json(),
            "provenance": provenance_here(policy.card.device, policy.card.dtype),
            "replay": _replay_check(batch),
            "items": {"asked": len(requested), "played": len(items)},
            "supported": policy.interventions.to_json(),
            "edits": _ledgers(conditions, batch),
            "unread": list(unread_places(patterns, policy.every_stream(), policy.interventions)),
            "passed_over": session.passed_over,
            **session.certificate,
        }
    outcomes = outcomes_of(run, [condition.name for condition in conditions], batch)
    measurement = Measurement(
        outcomes, settings, certificate, extra_files.__getitem__, tiles_apart=tiles_apart(run)
    )
    save(run.location, settings, key, outcomes, effects_csv(measurement), certificate, extra_files)
    pieces.discard()
    return load_effects(run, key)


def _check_roles(session: ReplaySession, settings: Mapping[str, Any], usual: Sequence[str]) -> None:
    """Raise UsageError for a role that nothing at the asked sites plays: the table would be silent about it.

    usual: the roles of the kind if none are named, of which one that is there will do.
    """
    roles, sites = settings.get("roles"), settings.get("sites")
    sites_and_roles = [(sites, roles)] if roles and sites else []
    targets = map(ConditionName.parse, settings.get("targets", ()))
    sites_and_roles += [([target.site], [target.role]) for target in targets]
    for patterns, requested in sites_and_roles:
        streams = [group.stream for pattern in patterns for group in resolve_sites(pattern, session.policy)]
        check_roles_have_tokens(session.policy, tuple(dict.fromkeys(streams)), requested, usual)


def _patterns(settings: Mapping[str, Any]) -> list[str]:
    """The patterns of places that an intervention changes."""
    targets = [ConditionName.parse(target).site for target in settings.get("targets", ())]
    return [*settings.get("sites", ()), *targets]


def unread_sites(run: Run, intervention: Intervention) -> tuple[str, ...]:
    """Places of an intervention that nothing reads, as the run's family declares, before anything is loaded."""
    family = get_family(run.model)
    if family is None:
        return ()
    return unread_places(_patterns(settings_of(intervention, run)), run.streams, family.interventions)


def check_supported(run: Run, intervention: Intervention) -> None:
    """Raise UnsupportedInterventionError, before anything is loaded, for what the run's family does not do."""
    if (family := get_family(run.model)) is not None:
        for kind in intervention.required_capabilities:
            family.check_intervention(kind)


def too_few_groups(run: Run, intervention: Intervention) -> dict[str, int]:
    """Return by category the number of groups of items, where an image swap cannot find *not used* in so few.

    Empty for other kinds; see `groups_for_not_used`.
    """
    if not isinstance(intervention, ImageSwap) or not has_sides(run):
        return {}
    episodes = run.episodes[run.episodes["item_id"].isin(intervention.items_in(run))]
    counts = episodes.groupby("category", sort=False)["group_id"].nunique()
    return {str(name): int(count) for name, count in counts.items() if count < groups_for_not_used()}


def _replay_items(
    session: ReplaySession,
    intervention: Intervention,
    items: Sequence[str],
    conditions: Sequence[Condition],
    pieces: Pieces,
    progress: Progress | None,
) -> ReplayBatch:
    """Replay item by item; items of an interrupted attempt are loaded."""
    parts = []
    for number, item in enumerate(items):
        name = f"{number:06d}"
        stored = pieces.read(name)
        if stored is not None:
            part = ReplayBatch(**stored)
        elif intervention.readout == PER_STEP:
            part = evaluate_per_step(session, session.pairs(item), conditions)
        else:
            part = intervention.play(session, item, conditions)
        if stored is None:
            pieces.keep(name, part.arrays)
        parts.append(part)
        if progress is not None:
            progress(number + 1, len(items), item)
    return ReplayBatch.joined(parts)


def outcomes_of(run: Run, conditions: Sequence[str], batch: ReplayBatch) -> ConditionOutcomes:
    """Return the numbers of K conditions with their episodes. conditions: names of the K, the clean one first."""
    rows = run.episodes.iloc[batch.rows]
    columns: dict[str, Any] = {
        field: rows[name].to_numpy(dtype=str)
        for field, name in (
            ("episodes", "episode_id"), ("items", "item_id"), ("groups", "group_id"), ("categories", "category"),
        )
    }  # fmt: skip
    columns["sides"] = rows["side_correct"].to_numpy(dtype=str) if has_sides(run) else np.full(len(rows), "")
    if run.recorded:
        names = zip(columns["episodes"], batch.steps, strict=True)
        columns["episodes"] = np.array([f"{episode}@{frame}" for episode, frame in names])
    # Toward the source's action, of all its inputs if they were played.
    toward, references = None, [name for name in (DONOR, IMAGE_SWAP) if name in conditions]
    if batch.chunks is not None and references:
        toward = displacements_toward(batch.chunks, list(conditions).index(references[0]))
    return ConditionOutcomes(
        conditions=tuple(conditions),
        **columns,
        displacement=batch.displacement if has_sides(run) or toward is None else toward,
        toward=toward,
        size=None if batch.chunks is None else sizes(batch.chunks),
        max_action_change=batch.max_action_change,
        edit_log=batch.edit_log,
        replay_error=batch.replay_error,
        episode_outcomes=batch.episode_outcomes,
        seed_text=run.seed_text,
    )


def _replay_check(batch: ReplayBatch) -> dict[str, Any]:
    """Return how many clean inferences are the run's, bit for bit."""
    errors = batch.replay_error[~np.isnan(batch.replay_error)]
    return {
        "episodes": int(batch.replay_error.size),
        "compared": int(errors.size),
        "equal": int((errors == 0).sum()),
        "largest_difference": float(errors.max(initial=0.0)),
        # One that differs stops an intervention before anything is stored.
        **({} if batch.episode_outcomes is None else {"outcomes_equal": int(batch.replay_error.size)}),
    }


def _ledgers(conditions: Sequence[Condition], batch: ReplayBatch) -> dict[str, dict[str, float]]:
    """Per condition that changed streams: fires, fires that moved nothing, and norms as means over fires.

    Raises CaptureChangedActionError if coefficient 0 changed an action.
    """
    ledgers = {}
    for number, condition in enumerate(conditions):
        rows = dict(zip(LOG_FIELDS, batch.edit_log[number].T, strict=True))
        fires = float(rows["fires"].sum())
        if not fires:
            continue
        means = {name: float((rows[name] * rows["fires"]).sum() / fires) for name in ("norm", "change")}
        ledgers[condition.name] = {
            "fires": fires, "no_op_fires": float(rows["no_op_fires"].sum()), **means,
            "largest_change": float(rows["largest_change"].max()),
            "max_action_change": float(batch.max_action_change[number].max()),
        }  # fmt: skip
        if ConditionName.parse(condition.name).coefficient == "0" and batch.max_action_change[number].any():
            raise CaptureChangedActionError(
                f"{condition.name} adds nothing and changed an action by "
                f"{batch.max_action_change[number].max():.3g}; "
                "expected the same bit for bit. The adapter's tap does not write what it reads, or the model is "
                "not deterministic"
            )
    return ledgers
