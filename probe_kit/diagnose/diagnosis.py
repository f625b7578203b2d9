"""A diagnosis of a run: every input's importance and passage, stored in the run and loaded from it.

The knowledge of a target is that of `probe-kit train`'s probes, which the run stores too.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from datetime import UTC, datetime
from math import nan
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from probe_kit.diagnose.importance import ActionScale
from probe_kit.diagnose.inputs import cameras_of, check_groups, frames_of, names_of, tabled_frames
from probe_kit.diagnose.measure import Actions, Infer, InputExchange
from probe_kit.diagnose.results import (
    FRAMES,
    LIKE_NONE,
    Diagnosis,
    InputDiagnosis,
    Knowledge,
    SiteKnowledge,
    SitePassage,
    check_names,
)
from probe_kit.errors import CheckpointError, ObservationError, UnsupportedInterventionError, UsageError
from probe_kit.extract.sources.inputs import STATE, with_input
from probe_kit.extract.sources.source import STATE_UNITS
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.sites import KV_STREAM
from probe_kit.hooks.family import SIZE
from probe_kit.intervene.further_instructions import check_further_instructions
from probe_kit.intervene.open_session import check_readable
from probe_kit.intervene.pairs import Chunk, Given, Pair, PairRow
from probe_kit.intervene.patching.patch import Cell, patch_while_inferring
from probe_kit.intervene.places import ALL, SiteGroup, resolve_sites
from probe_kit.intervene.settings import key_of
from probe_kit.intervene.tokens import PairTokens, roles_of_tokens
from probe_kit.runs.layout import DIAGNOSES, UNITS
from probe_kit.runs.reader import origin_of
from probe_kit.runs.records import as_json
from probe_kit.runs.results import find_bundle, read_bundle, write_bundle
from probe_kit.train.choices import EVERYWHERE

if TYPE_CHECKING:
    from probe_kit.hooks import ActivationCache, Model, Policy
    from probe_kit.hooks.contract.observation import Observation
    from probe_kit.intervene.sessions import LoadPolicy, ReplayFiles, ReplaySession
    from probe_kit.runs.run import Run
    from probe_kit.train import Target


# -- the knowledge of a target -------------------------------------------------------------------------------


def measure_knowledge(run: "Run", target: "Target | str", seed: int = 0) -> Knowledge:
    """Probe a target at every site of a run, all episodes pooled, or load these probes.

    Raises as `train_probes`, such as TooFewGroupsError.
    """
    from probe_kit.retention.estimators import retention_of
    from probe_kit.train import train_probes

    results = train_probes(run, [EVERYWHERE], target=target, seed=seed)
    # A layer of a stream with iterations is one site of a diagnosis: the farthest above chance stands for it. As
    # the largest of several it is biased upward; the retention below is by sites that other questions chose.
    frame = results.scores.assign(excess=lambda scores: scores["score"] - scores["chance"])
    best = frame.sort_values("excess", ascending=False).drop_duplicates(["stream", "layer"]).sort_index()
    sites = tuple(
        SiteKnowledge(f"{stream}.{layer:02d}", part, float(score), float(chance), bool(signal))
        for stream, layer, part, score, chance, signal in zip(
            *(best[name] for name in ("stream", "layer", "part", "score", "chance", "signal")), strict=True
        )
    )
    retained = retention_of(results, EVERYWHERE, results.settings.views[0])
    low, high = (retained.interval.low, retained.interval.high) if retained.interval.bounded else (nan, nan)
    metric = str(frame["metric"].iloc[0])
    return Knowledge(
        results.settings.target, results.key, metric, sites, retained.value, (low, high), retained.note
    )


# -- the passage of an input ---------------------------------------------------------------------------------


def sites_of(model: "Model") -> list[SiteGroup]:
    """Return every layer of every stored stream and the keys and values of the backbone, in network order."""
    streams = list(model.streams)
    if model.prompt_kv is not None:
        streams.insert(1, KV_STREAM)
    return [group for stream in streams for group in resolve_sites(f"{stream}.*", model)]


def measure_passage(
    session: "ReplaySession", pairs: Sequence[Pair], scale: ActionScale
) -> tuple[SitePassage, ...]:
    """Return difference and carried share at every site, over pairs of equally many tokens; see `SitePassage`.

    Takes two inferences per pair, and one per site. Raises as `capture` and `patch_while_inferring`.

    Args:
        session: The run's policy and its observations.
        pairs: Clean and donor observations of equally many tokens.
        scale: The spread of the session's actions.
    """
    model, groups = session.policy, sites_of(session.policy)
    differences = np.zeros((len(pairs), len(groups)))
    moved, squares = np.zeros((len(pairs), len(groups))), np.zeros(len(pairs))
    for row, pair in enumerate(pairs):
        clean, before = _capture_inference(session, pair.clean, pair.seed, groups)
        donated, donor = _capture_inference(session, pair.source, pair.seed, groups)
        change = scale.changes(donated[None], clean[None])[0]
        squares[row] = change @ change
        tokens = PairTokens(model, pair)
        for column, group in enumerate(groups):
            differences[row, column] = _relative_difference(group, before, donor)
            # Elsewhere the patch would put in what is there already: an inference saved, and a share of 0.
            if squares[row] and differences[row, column] > LIKE_NONE:
                with patch_while_inferring(tokens, [Cell(group, ALL)], donor):
                    edited = session.act(pair.clean, pair.seed)
                moved[row, column] = scale.changes(edited[None], clean[None])[0] @ change
    # Least squares through 0, of the patch's change on the donor's over all pairs. As a ratio of sums it gives
    # pairs whose action hardly changes little weight, where a mean of ratios would divide by almost 0.
    shares = moved.sum(axis=0) / squares.sum() if squares.any() else np.full(len(groups), np.nan)
    return tuple(
        SitePassage(group.name, float(difference), float(share))
        for group, difference, share in zip(groups, differences.mean(axis=0), shares, strict=True)
    )


def _capture_inference(
    session: "ReplaySession", observation: Given, seed: int, groups: Sequence[SiteGroup]
) -> "tuple[Chunk, ActivationCache]":
    """Return the actions and the activations of one inference.

    The actions are in the session's units; those of recordings are the checkpoint's own.
    """
    from probe_kit.hooks import capture

    with capture(session.policy, [site for group in groups for site in group.sites]) as cache:
        chunk = session.act(observation, seed)
    return chunk, cache


def _relative_difference(group: SiteGroup, before: "ActivationCache", after: "ActivationCache") -> float:
    """Return the norm of the difference over all tokens and iterations of a place, relative to the norm before."""
    difference = norm = 0.0
    for site in group.sites:
        clean, donated = before[site].float(), after[site].float()
        difference += float((donated - clean).square().sum())
        norm += float(clean.square().sum())
    return float(np.sqrt(difference / norm)) if norm else 0.0


# -- the diagnosis of a run ----------------------------------------------------------------------------------

FORMAT, FILE = "probe_kit diagnosis 5", "diagnosis.json"
Announce = Callable[[str], None]


def diagnose_run(
    run: "Run",
    *,
    frames: int = FRAMES,
    inputs: Sequence[str] = (),
    inside: bool = True,
    paraphrases: Mapping[str, str] = MappingProxyType({}),
    target: "Target | str | None" = None,
    base: str | None = None,
    pairs: Sequence[PairRow] = (),
    instructions: Sequence[str] = (),
    seed: int = 0,
    source: "ReplayFiles | None" = None,
    load: "LoadPolicy | None" = None,
    progress: Announce = lambda _: None,
) -> Diagnosis:
    """Diagnose the inputs of a run's model on first frames of the run; a stored diagnosis is loaded.

    Raises for a target as `train_probes` too.

    Args:
        run: The stored run whose model and observations are used.
        frames: Number of frames.
        inputs: Names of the inputs, such as `instruction`; empty for all.
        inside: Whether sites are patched.
        paraphrases: Other words of the same meaning, by instruction; they are the control of the instruction.
        target: Probed at every site, as by `train_probes`; None for no probes.
        base: The checkpoint that the run's was tuned from, for a comparison on the same pairs; None for none.
        pairs: A table of your own in place of drawn donors: episode and frame, and those of the donor; `frames` is
            then not used.
        instructions: Words of other tasks, beside the instructions of the frames, for a run that has one task.
        seed: Seed of the draw of donors and of the probes.
        source: Where the model and the observations are now, as for `run_intervention`. The base is loaded by it
            too.
        load: Loads the policy, as for `run_intervention`, and the base too.
        progress: Called with the name of every step.

    Raises:
        UsageError: For a model that does not act, a run with too few groups, an unknown input, a pair of a frame
            that the run lacks, an instruction that the run has already, or a base with other inputs.
        InstructionError: For instructions that the policy cannot read in full.
    """
    from probe_kit.intervene.open_session import load_policy_of, open_session
    from probe_kit.intervene.sessions import ReplayFiles

    source = source or ReplayFiles()
    check_diagnosis(run, frames, inputs, pairs, instructions, source, None if load is not None else base)
    if target is not None:
        progress("probes")
    knowledge = None if target is None else measure_knowledge(run, target, seed)
    base_policy = None if base is None else (load or load_policy_of)(run, replace(source, checkpoint=base))
    settings = {
        "format": FORMAT,
        "stamp": run.stamp,
        **({"pairs": [list(row) for row in pairs]} if pairs else {"frames": frames}),
        "inputs": list(inputs),
        "inside": inside,
        "paraphrases": dict(paraphrases),
        **({"instructions": list(instructions)} if instructions else {}),
        "base": None if base_policy is None else base_policy.card.weights_sha256,
        "seed": seed,
    }
    key = key_of(settings)
    if (stored := find_bundle(run.location, DIAGNOSES, key)) is not None:
        return replace(stored.read_as(FILE, Diagnosis.from_json, FORMAT), knowledge=knowledge)
    with open_session(run, source, load, table=pairs, instructions=instructions) as session, session.ready():
        if base_policy is not None:
            base_policy = with_inputs_of(session.policy, base_policy)
        progress("frames")
        if pairs:
            drawn, rows = tabled_frames(session, pairs, paraphrases)
        else:
            drawn, rows = frames_of(session, frames, paraphrases), []
        exchange = InputExchange(_inference(session), drawn, seed, rows, instructions)
        diagnosed = _measure(session, exchange, inputs, inside, progress)
        if base_policy is not None:
            progress("inputs of the base")
            diagnosed = exchange.against(_inference(session, base_policy), diagnosed)
    clean = [drawn[index] for index in dict(rows)] or drawn  # of a table of pairs, each clean frame once
    groups = len({frame.group for frame in clean})
    diagnosis = Diagnosis(
        key,
        run.label,
        len(clean),
        groups,
        with_units(run, diagnosed),
        base or "",
        weights_sha256=str(run.weights_sha256),
        checkpoint=str(run.certificate["policy"]["checkpoint"]),
        random_weights=run.random_weights,
        source=run.suite,
        settings=settings,
    )
    now = datetime.now(UTC).isoformat(timespec="microseconds")
    files = {FILE: as_json(diagnosis.to_json())}
    write_bundle(run.location, DIAGNOSES, key, {"settings": settings}, files, {"created": now})
    return replace(diagnosis, knowledge=knowledge)


def check_diagnosis(
    run: "Run",
    frames: int,
    inputs: Sequence[str],
    pairs: Sequence[PairRow],
    instructions: Sequence[str],
    source: "ReplayFiles",
    base: str | None,
) -> None:
    """Check, before any weights are read, that a run can be diagnosed so; raises as `diagnose_run`.

    The frames of a table of pairs are looked up when the source is open, see `open_session`.
    """
    check_network(run)
    if not pairs:
        check_groups(run.episodes, frames, run.source.is_scene, lambda: f"{run.location} has")
    cameras = cameras_of(run)
    check_names(inputs, names_of(cameras))
    if instructions:
        check_further_instructions(instructions, run.episodes["instruction"].astype(str), bool(pairs))
        check_readable(run, source, instructions)
    if base is not None:
        check_base(run, source, base, cameras)


def with_units(run: "Run", inputs: Sequence[InputDiagnosis]) -> tuple[InputDiagnosis, ...]:
    """Return the inputs; the state has the numbers that did not fit the checkpoint's statistics in the run."""
    note = run.settings.get(UNITS, {}).get(STATE_UNITS)
    if note is None:
        return tuple(inputs)
    return tuple(
        replace(diagnosed, units=note["misfits"], units_are_other=note["are_other"])
        if diagnosed.name == STATE
        else diagnosed
        for diagnosed in inputs
    )


def check_network(run: "Run") -> None:
    """Raise UsageError for a run of a scripted model, which has no inputs to exchange."""
    if run.weights_sha256 is None or not run.streams:
        raise UsageError(f"{run.location}: {run.model} is scripted and has no network; diagnose a policy")


def load_diagnosis(run: "Run", key: str) -> Diagnosis:
    """Load a stored diagnosis, without a target.

    Args:
        run: The run that stores it.
        key: Key of the diagnosis in the run.

    Raises:
        RunDamagedError: If it was changed, or another version of probe_kit made it.
    """
    return read_bundle(run.location, DIAGNOSES, key).read_as(FILE, Diagnosis.from_json, FORMAT)


def check_base(run: "Run", source: "ReplayFiles", base: str, cameras: Sequence[str]) -> None:
    """Check the base against the run's checkpoint by the files of both; raises as `check_base_files`."""
    origin = origin_of(run)
    checkpoint, options = source.checkpoint or origin.checkpoint, {**origin.options, **source.options}
    check_base_files(run.model, checkpoint, base, options, cameras)


def check_base_files(
    family_name: str,
    checkpoint: str | None,
    base: str,
    options: Mapping[str, Any],
    cameras: Sequence[str],
    fetch: bool = True,
) -> None:
    """Check that the base exists and that its files declare the same inputs; raises as `Family.check` too.

    No weights are read.

    Args:
        family_name: Name of the family of both models.
        checkpoint: Checkpoint of the model that was tuned from the base; None for the embedded one.
        base: Checkpoint of the base.
        options: Options of the family for the tuned model.
        cameras: Cameras that get a picture.
        fetch: Whether files may be downloaded, see `Family.check`.

    Raises:
        UsageError: If the files of the base declare other inputs.
    """
    from probe_kit.hooks.contract.model import Policy
    from probe_kit.hooks.registry import get_family

    if (family := get_family(family_name)) is None:
        return
    # The option `size` chooses a released checkpoint of the family; here `base` names the checkpoint itself.
    unsized = {name: value for name, value in options.items() if name != SIZE}
    try:
        family.check(base, options=unsized, fetch=fetch)
    except CheckpointError as error:
        # Its own advice is about the model of a command, which is the tuned one here.
        raise type(error)(f"the base: {error}. Give the checkpoint that this one was tuned from") from error
    checkpoint = None if checkpoint in ("", EMBEDDED) else checkpoint
    outlines = (
        family.outline(checkpoint, options if checkpoint is None else unsized),
        family.outline(base, unsized),
    )
    tuned, before = (None if outline is None else outline.model for outline in outlines)
    if isinstance(tuned, Policy) and isinstance(before, Policy):
        with_inputs_of(tuned.with_cameras(cameras), before)


def with_inputs_of(tuned: "Policy", base: "Policy") -> "Policy":
    """Return the base with the cameras of the checkpoint that was tuned from it.

    Raises:
        UsageError: For a base with other inputs.
    """
    cameras = tuned.card.shown_cameras
    if base.card.shown_cameras != cameras:
        with suppress(ObservationError):
            base = base.with_cameras(cameras)
    for what, now, before in (
        ("cameras", cameras, base.card.shown_cameras),
        ("numbers of the state", tuned.state_numbers, base.state_numbers),
        ("further inputs", tuned.card.needs, base.card.needs),
        ("absent inputs", tuned.absent_inputs, base.absent_inputs),
    ):
        if now != before:
            raise UsageError(
                f"the base {base.card.checkpoint} has other inputs: its {what} are {_plain(before)}, those of "
                f"{tuned.card.checkpoint} {_plain(now)}. Give the checkpoint that this one was tuned from"
            )
    return base


def _plain(inputs: object) -> object:
    return sorted(inputs) if isinstance(inputs, frozenset) else inputs


def _inference(session: "ReplaySession", policy: "Policy | None" = None) -> Infer:
    """Return a function that infers one by one in a session.

    Args:
        session: Prepares the observations and holds the policy.
        policy: Another policy on the same observations; None for the session's.
    """
    acting = copy(session)  # which keeps its own policy for the measurements inside
    acting.policy = policy or session.policy

    def infer(observations: Sequence["Observation"], seeds: Sequence[int]) -> Actions:
        return np.stack([acting.act(*inference) for inference in zip(observations, seeds, strict=True)])

    return infer


def _measure(
    session: "ReplaySession", exchange: InputExchange, names: Sequence[str], inside: bool, progress: Announce
) -> tuple[InputDiagnosis, ...]:
    progress("inputs")
    policy = session.policy
    absent = policy.absent_inputs | ({STATE} if policy.state_numbers is None else set())
    camera = policy.card.cameras[0] if policy.card.cameras else ""
    inputs = []
    for diagnosed in exchange.measure(names, absent=absent, camera=camera):
        progress(f"sites of {diagnosed.name}")
        inputs.append(_look_inside(session, exchange, diagnosed) if inside else diagnosed)
    return tuple(inputs)


def _look_inside(session: "ReplaySession", exchange: InputExchange, diagnosed: InputDiagnosis) -> InputDiagnosis:
    """Return the input with its sites, if it was exchanged; each frame has one donor of equally many tokens."""
    if diagnosed.matters is None:  # it was not exchanged: the policy or the run has no such input
        return diagnosed
    frames = exchange.frames
    pairs = []
    for index, donor in exchange.first_donors(diagnosed.name):
        clean = exchange.observations[index]
        source = with_input(clean, diagnosed.name, exchange.candidates(diagnosed.name)[donor].observation)
        if _as_many_tokens(session.policy, clean, source):
            pairs.append(Pair(clean, source, frames[index].seed, group=frames[index].group))
    if not pairs:
        return replace(diagnosed, note="sites were not patched: no two inputs have equally many tokens")
    try:
        return replace(diagnosed, passage=measure_passage(session, pairs, exchange.scale))
    except UnsupportedInterventionError as error:
        return replace(diagnosed, note=f"sites were not patched: {error}")


def _as_many_tokens(policy: "Policy", clean: "Observation", source: "Observation") -> bool:
    first, second = (
        {stream: len(roles) for stream, roles in roles_of_tokens(policy, observation).items()}
        for observation in (clean, source)
    )
    return first == second
