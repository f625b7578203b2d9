"""Carrying out an intervention: replay what is missing, store it, say what it means."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit._terminal.notebook import notebook_progress
from probe_kit.errors import CaptureChangedActionError
from probe_kit.extract.run_layout import INTERVENTIONS
from probe_kit.extract.store.format.bundles import tidy_bundle
from probe_kit.extract.store.format.resume_pieces import Pieces
from probe_kit.extract.store.run import Run
from probe_kit.hooks.registry import known_families
from probe_kit.intervene.edits.patching import LEDGER
from probe_kit.intervene.edits.sites import places, check_unplayed
from probe_kit.intervene.kinds.closed_loop.intervention import CELL
from probe_kit.intervene.kinds.image_swap.intervention import Follow
from probe_kit.intervene.kinds.interchange.intervention import ROLES
from probe_kit.intervene.kinds.site_effects import Named
from probe_kit.intervene.replay.conditions import Condition, Intervention, Replayed
from probe_kit.intervene.replay.per_step import shadowed
from probe_kit.intervene.replay.session import Bench, Progress, Source, open_bench
from probe_kit.intervene.results.results import Effects, effects_csv, load_effects
from probe_kit.intervene.store.answers import EXCHANGED, Answers, is_stored, save
from probe_kit.intervene.store.settings import SHADOW, items_of, key_of, check_unfit, settings_of

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

REDO = "the same `probe-kit intervene` then plays it again"


def intervene_on(
    run: Run,
    asked: Intervention | None = None,
    source: Source | None = None,
    *,
    load: "Callable[[Run, Source], Policy] | None" = None,
    progress: Progress | None = None,
    learning: Progress | None = None,
) -> Effects:
    """Intervene on a run's policy, and store what came of it with the run; what is stored is read back.

    asked: what to do; `Follow()` by default. source: where policy and pictures are, by default the embedded suite
    and the model's own checkpoint. load: how the policy is found, if not by its name. progress: told of items
    replayed; learning: of items inferred before that, where directions or erasers of tokens are found. What was
    interrupted is continued. Raises UsageError for a run whose policy did not act, UnknownCategoryError, and what
    `open_bench` raises.
    """
    asked = asked or Follow()
    check_unfit(run)
    check_unsupported(run, asked)
    settings = settings_of(asked, run)
    key = key_of(settings)
    if is_stored(run.location, key):
        tidy_bundle(run.location, INTERVENTIONS, key)
    else:
        _carry_out(run, asked, settings, key, source or Source(), load, progress, learning)
    return load_effects(run, key)


def _carry_out(
    run: Run,
    asked: Intervention,
    settings: Mapping[str, Any],
    key: str,
    source: Source,
    load: "Callable[[Run, Source], Policy] | None",
    progress: Progress | None,
    learning: Progress | None,
) -> None:
    pieces = Pieces.of(run.location, INTERVENTIONS, key, run.stamp, REDO)
    wanted = items_of(run, asked)
    with open_bench(run, source, load) as bench, bench.ready():
        bench.learning = learning or notebook_progress("items learnt from")
        _check_unplayed_roles(bench, settings)
        items = asked.playable(bench, wanted)
        conditions = asked.conditions(bench)
        parts = _replayed(bench, asked, items, conditions, pieces, progress or notebook_progress("items replayed"))
        certificate = {
            "policy": bench.policy.card.to_json(),
            "provenance": _provenance(bench),
            "replay": _replay_check(parts),
            "items": {"asked": len(wanted), "played": len(items)},
            "supported": bench.policy.interventions.to_json(),
            "edits": _ledgers(conditions, parts),
            **asked.told(conditions, parts),
        }
    answers = answers_of(run, [condition.name for condition in conditions], parts)
    further = asked.files(run, conditions, parts)
    effects = effects_csv(answers, run.suite, str(settings.get("toward", EXCHANGED)), asked.kind, further)
    save(run.location, settings, key, answers, effects, certificate, further)
    pieces.discard()


def _check_unplayed_roles(bench: Bench, settings: Mapping[str, Any]) -> None:
    """Raise UsageError for a role that nothing at the asked sites plays: the table would be silent about it."""
    roles, sites = settings.get("roles"), settings.get("sites")
    asked = [(sites, roles)] if roles and sites else []
    asked += [([pattern], [role]) for pattern, role in (cell.split(CELL) for cell in settings.get("cells", ()))]
    for patterns, wanted in asked:
        found = [place.stream for pattern in patterns for place in places(pattern, bench.policy)]
        check_unplayed(bench.policy, tuple(dict.fromkeys(found)), wanted, ROLES)


def check_unsupported(run: Run, asked: Intervention) -> None:
    """Raise UnsupportedInterventionError, before anything is loaded, for what the run's family does not do."""
    if (family := known_families().get(run.model)) is not None:
        for kind in asked.needs:
            family.check_intervention(kind)


def _replayed(
    bench: Bench,
    asked: Intervention,
    items: Sequence[str],
    conditions: Sequence[Condition],
    pieces: Pieces,
    progress: Progress | None,
) -> Replayed:
    """Item by item; what a former attempt finished is read back."""
    parts = []
    for number, item in enumerate(items):
        name = f"{number:06d}"
        stored = pieces.read(name)
        if stored is None:
            part = _played(bench, asked, item, conditions)
            pieces.keep(name, part.arrays)
        else:
            part = Replayed(**stored)
        parts.append(part)
        if progress is not None:
            progress(number + 1, len(items), item)
    return Replayed.joined(parts)


def _played(bench: Bench, asked: Intervention, item: str, conditions: Sequence[Condition]) -> Replayed:
    if asked.readout == SHADOW:
        return shadowed(bench, bench.questions(item), conditions)
    return asked.play(bench, item, conditions)


def answers_of(run: Run, conditions: Sequence[str], found: Replayed) -> Answers:
    """What K conditions gave, and for which episodes. conditions: names of the K, the plain one first."""
    rows = run.episodes.iloc[found.rows]
    columns = {
        own: rows[name].to_numpy(dtype=str)
        for own, name in (
            ("episodes", "episode_id"), ("items", "item_id"), ("groups", "group_id"), ("categories", "category"),
            ("sides", "side_correct"),
        )
    }  # fmt: skip
    return Answers(
        conditions=tuple(conditions),
        **columns,
        lateral=found.lateral,
        changed=found.changed,
        ledger=found.ledger,
        apart=found.apart,
        outcomes=found.outcomes,
    )


def _replay_check(found: Replayed) -> dict[str, Any]:
    """Whether the plain inferences are the run's, bit for bit."""
    known = found.apart[~np.isnan(found.apart)]
    return {
        "episodes": int(found.apart.size),
        "compared": int(known.size),
        "equal": int((known == 0).sum()),
        "largest_difference": float(known.max(initial=0.0)),
        # One that differs stops an intervention before anything is stored.
        **({} if found.outcomes is None else {"outcomes_equal": int(found.apart.size)}),
    }


def _ledgers(conditions: Sequence[Condition], found: Replayed) -> dict[str, dict[str, float]]:
    """Per condition that changed streams: fires, fires that moved nothing, and norms as means over fires.

    Raises CaptureChangedActionError if a dose of zero changed an action.
    """
    said = {}
    for number, condition in enumerate(conditions):
        rows = dict(zip(LEDGER, found.ledger[number].T, strict=True))
        fires = float(rows["fires"].sum())
        if not fires:
            continue
        means = {name: float((rows[name] * rows["fires"]).sum() / fires) for name in ("norm", "moved")}
        said[condition.name] = {
            "fires": fires, "still": float(rows["still"].sum()), **means, "largest": float(rows["largest"].max()),
            "largest_change": float(found.changed[number].max()),
        }  # fmt: skip
        if Named.of(condition.name).dose == "0" and found.changed[number].any():
            raise CaptureChangedActionError(
                f"{condition.name} adds nothing and changed an action by {found.changed[number].max():.3g}; "
                "expected the same bit for bit. The adapter's tap does not write what it reads, or the model is "
                "not deterministic"
            )
    return said


def _provenance(bench: Bench) -> dict[str, Any]:
    from probe_kit.extract.store.provenance import provenance_here

    return provenance_here(bench.policy.card.device, bench.policy.card.dtype)
