"""Running of an intervention: it replays what is missing, stores it, and reads the result."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._system.types import Progress
from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import CaptureChangedActionError, UsageError
from probe_kit.hooks.capturing.edits import LOG_FIELDS
from probe_kit.hooks.registry import get_family
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.intervene.kinds.image_swap import ImageSwap
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.outcomes import ConditionOutcomes, arrays_of
from probe_kit.intervene.places import ALL, resolve_all, roles_of, unread_note, unread_places
from probe_kit.intervene.replay import Condition
from probe_kit.intervene.results import InterventionResult, find_effects, save
from probe_kit.intervene.sessions import LoadPolicy, ReplayFiles, ReplaySession
from probe_kit.intervene.settings import check_run_fits, key_of, settings_of
from probe_kit.runs.layout import INTERVENTIONS
from probe_kit.runs.provenance import provenance_here
from probe_kit.runs.results import Pieces, tidy_bundle
from probe_kit.runs.run import Run
from probe_kit.statistics.sufficiency import groups_for_not_used

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

REDO = "the same `probe-kit intervene` then plays it again"
"""Remedy for a damaged piece of an unfinished intervention."""


def run_intervention(
    run: Run,
    intervention: Intervention | None = None,
    source: ReplayFiles | None = None,
    *,
    load: LoadPolicy | None = None,
    progress: Progress | None = None,
    on_fit_progress: Progress | None = None,
    on_note: Callable[[str], None] = lambda _: None,
) -> InterventionResult:
    """Intervene on a run's policy and store the result with the run; a stored result is loaded.

    An interrupted intervention is resumed. Raises as `open_session` too.

    Args:
        run: Run whose policy acted.
        intervention: Kind with its settings; None for `ImageSwap()`.
        source: Places of the policy and the pictures; None for the embedded suite and the model's own checkpoint.
        load: Function that loads the policy; None to load it by its name.
        progress: Function that is called after every replayed item; None for a progress bar in a notebook.
        on_fit_progress: Function that is called after every item inferred before that, where directions or erasers
            are fitted; None likewise.
        on_note: Function that is called before the replay with a sentence about edits that cannot change anything;
            `notes` has it too.

    Raises:
        UsageError: For a run whose policy did not act.
        UnknownCategoryError: For a category that the run lacks.
    """
    intervention = intervention or ImageSwap()
    check_intervention(run, intervention)
    settings = settings_of(intervention, run)
    key = key_of(settings)
    if (stored := find_effects(run, key)) is not None:
        tidy_bundle(run.location, INTERVENTIONS, key)
        return stored
    pieces = Pieces.of(run.location, INTERVENTIONS, key, run.stamp, REDO)
    requested = intervention.items_in(run)
    with open_session(run, source or ReplayFiles(), load, intervention) as session, session.ready():
        policy = session.policy
        session.on_fit_progress = on_fit_progress or notebook_progress("items learnt from")
        check_roles(intervention, policy)
        items = intervention.eligible_items(session, requested)
        conditions = intervention.conditions(session)
        places = [name for condition in conditions for name in condition.places]
        unread = unread_places(places, policy.every_stream(), policy.interventions)
        if unread:
            on_note(unread_note(unread))
        progress = progress or notebook_progress("items replayed")
        outcomes = _replay_items(session, intervention, items, conditions, pieces, progress)
        extra_files = intervention.extra_files(session, conditions, outcomes)
        # What made the numbers and what was checked of them; the notes below a table are made of it.
        certificate = {
            "policy": policy.card.to_json(),
            "provenance": provenance_here(policy.card.device, policy.card.dtype),
            "replay": _replay_check(outcomes),
            "items": {"asked": len(requested), "played": len(items)},
            "supported": policy.interventions.to_json(),
            "edits": _ledgers(outcomes),
            "unread": list(unread),
            "passed_over": session.passed_over,
            **session.certificate,
        }
    # Only now: the unit, spreads of all clean actions, is known once every item was replayed.
    save(run, settings, outcomes.in_spreads(), certificate, extra_files)
    pieces.discard()  # only now: killed in between, the result is there, and the pieces are tidied away
    stored = find_effects(run, key)
    assert stored is not None, "it was written just now"
    return stored


def check_roles(intervention: Intervention, policy: "Policy") -> None:
    """Refuse a role that no token at its sites has: it would be missing from the table without notice.

    The default roles are tried where none are named; then one of them that the policy has is enough.

    Raises:
        UsageError: For a role that no token has.
    """
    default_roles = next((field.default for field in fields(intervention) if field.name == "roles"), ())
    patterns_of: dict[tuple[str, ...], list[str]] = {}
    for pattern, roles in intervention.patterns:
        patterns_of.setdefault(roles, []).append(pattern)
    for roles, patterns in patterns_of.items():
        streams = list(dict.fromkeys(group.stream for group in resolve_all(patterns, policy).values()))
        present = {role for stream in streams for role in roles_of(policy, stream, roles)}
        missing = [role for role in roles if role not in present]
        if missing and not (present and roles == default_roles):
            declared = [name for stream in streams for name in policy.role_names.get(policy.tokens_of(stream), ())]
            raise UsageError(
                f"no token of {', '.join(streams)} has the role {missing[0]!r}; expected one of "
                f"{', '.join(dict.fromkeys((ALL, *declared)))}"
            )


def check_intervention(run: Run, intervention: Intervention) -> None:
    """Refuse, before anything is loaded, a run on which an intervention cannot be made.

    Raises:
        UsageError: For a run without actions to compare, or an option that does not apply to it.
        UnknownCategoryError: For a category that the run lacks.
        UnsupportedInterventionError: For an intervention that the run's family does not support.
    """
    check_run_fits(run)
    intervention.check_run(run)
    if (family := get_family(run.model)) is not None:
        for kind in intervention.required_capabilities:
            family.check_intervention(kind)


def too_few_groups(run: Run, intervention: Intervention) -> dict[str, int]:
    """Return by category the number of groups of items, where an image swap cannot find *not used* in so few.

    Empty for other kinds; see `groups_for_not_used`.
    """
    if not isinstance(intervention, ImageSwap) or not run.source.is_scene:
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
) -> ConditionOutcomes:
    """Replay item by item; items of an interrupted attempt are loaded."""
    parts = []
    for number, item in enumerate(items):
        name = f"{number:06d}"  # the key covers the items and their order, so that a number is always the same one
        stored: dict[str, Any] | None = pieces.read(name, ConditionOutcomes)
        if stored is None:
            part = intervention.play(session, session.pairs(item), conditions)
            pieces.keep(name, arrays_of(part, ("seed_text",)))
        else:
            part = ConditionOutcomes(**stored)
        parts.append(part)
        if progress is not None:
            progress(number + 1, len(items), item)
    return ConditionOutcomes.joined(parts)


def _replay_check(outcomes: ConditionOutcomes) -> dict[str, Any]:
    """Return how many clean inferences are the run's, bit for bit."""
    errors = outcomes.replay_error[~np.isnan(outcomes.replay_error)]
    check: dict[str, Any] = {
        "episodes": int(outcomes.replay_error.size),
        "compared": int(errors.size),
        "equal": int((errors == 0).sum()),
        "largest_difference": float(errors.max(initial=0.0)),
    }
    if outcomes.episode_outcomes is not None:
        # All of them: `play` raises for an outcome that differs from the run's.
        check["outcomes_equal"] = int(outcomes.replay_error.size)
    return check


def _ledgers(outcomes: ConditionOutcomes) -> dict[str, dict[str, float]]:
    """Return per condition that changed streams: fires, fires that moved nothing, and norms as means over fires.

    Raises:
        CaptureChangedActionError: If coefficient 0 changed an action.
    """
    ledgers = {}
    for number, (name, cell) in enumerate(zip(outcomes.conditions, outcomes.cells, strict=True)):
        rows = dict(zip(LOG_FIELDS, outcomes.edit_log[number].T, strict=True))
        fires = float(rows["fires"].sum())
        if not fires:
            continue
        means = {field: float((rows[field] * rows["fires"]).sum() / fires) for field in ("norm", "change")}
        ledgers[name] = {
            "fires": fires, "no_op_fires": float(rows["no_op_fires"].sum()), **means,
            "largest_change": float(rows["largest_change"].max()),
            "max_action_change": float(outcomes.max_action_change[number].max()),
        }  # fmt: skip
        if cell.coefficient == "0" and outcomes.max_action_change[number].any():
            raise CaptureChangedActionError(
                f"{name} adds nothing and changed an action by "
                f"{outcomes.max_action_change[number].max():.3g}; "
                "expected the same bit for bit. The adapter's tap does not write what it reads, or the model is "
                "not deterministic"
            )
    return ledgers
