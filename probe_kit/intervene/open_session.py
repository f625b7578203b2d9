"""Opening of a run's session: its policy and its source are loaded again, and compared with the run's."""

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from probe_kit._system.table_cells import similar_name
from probe_kit.errors import SettingsMismatchError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import cached_folder, pinned_commits
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.family import SIZE
from probe_kit.intervene.frame_session import Frames, FrameSession
from probe_kit.intervene.pairs import Pair, PairRow
from probe_kit.intervene.scene_session import SceneSession
from probe_kit.intervene.sessions import LoadPolicy, ReplayFiles, ReplaySession
from probe_kit.intervene.settings import Choice, items_of
from probe_kit.runs.reader import origin_of
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


def load_policy_of(run: Run, source: ReplayFiles) -> "Policy":
    """Return the policy that a run names, loaded as its own process loaded it.

    A file whose weights call themselves random is loaded as a file: only requested random weights are drawn.
    """
    from probe_kit.hooks import load_policy

    origin = origin_of(run)
    checkpoint, options = checkpoint_of(run, source)
    # Branches of its vision-language model or tokenizer may have gone on since the run was made.
    with pinned_commits(origin.repositories):
        return load_policy(
            run.model,
            checkpoint,
            source.device,
            run.settings["dtype"],
            origin.random_weights,
            origin.weights_seed if source.weights_seed is None else source.weights_seed,
            **options,
        )


def checkpoint_of(run: Run, source: ReplayFiles) -> tuple[str | None, dict[str, Any]]:
    """Return the checkpoint of a run's policy on this machine, None for its family's own, and the options."""
    origin = origin_of(run)
    checkpoint = source.checkpoint or None
    if checkpoint is None:
        # Where the run had it, if its folder, or its commit of the hub, is here: none is fetched.
        before = origin.checkpoint
        is_folder = before not in ("", EMBEDDED) and Path(before).expanduser().is_dir()
        checkpoint = before if is_folder or cached_folder(before) is not None else None
    options = {name: value for name, value in origin.options.items() if checkpoint is None or name != SIZE}
    return checkpoint, {**options, **source.options}


def check_readable(run: Run, source: ReplayFiles, instructions: Sequence[str]) -> None:
    """Raise InstructionError for further instructions that the policy cannot read in full; no weights are read."""
    from probe_kit.hooks.registry import get_family

    if not instructions:
        return
    checkpoint, options = checkpoint_of(run, source)
    if (family := get_family(run.model)) is not None:
        family.check_words(instructions, checkpoint)
        family.check_instructions(checkpoint, instructions, options, fetch=False)


def check_policy(run: Run, policy: "Policy") -> None:
    """Refuse another policy than the run's.

    Raises:
        SettingsMismatchError: For other weights or options than the run's.
    """
    card = policy.card
    if card.weights_sha256 != run.weights_sha256:
        checkpoint = origin_of(run).checkpoint or "an unknown checkpoint"
        raise SettingsMismatchError(
            f"the weights of {card.checkpoint} are {card.weights_sha256[:12]}; {run.location} was made with "
            f"{str(run.weights_sha256)[:12]}, loaded from {checkpoint}. Give that --checkpoint (or --weights-seed)"
        )
    was, now = dict(run.settings.get("policy", {})), dict(card.settings)
    if was != now:
        different = sorted(name for name in was | now if was.get(name) != now.get(name))
        lines = "; ".join(f"{name}: stored {was.get(name)!r}, here {now.get(name)!r}" for name in different)
        raise SettingsMismatchError(f"{run.location} was made with other options ({lines}). Give the same with -M")


MOST_FRAMES = 8
"""Number of frames that a message names."""


def check_pairs(table: Sequence[PairRow], frames: Collection[tuple[str, int]]) -> None:
    """Refuse a table of pairs with frames that the run lacks.

    Args:
        table: Rows of the table.
        frames: Frames of the run, each an episode and a number.

    Raises:
        UsageError: For a row that names none of the frames.
    """
    for episode, number in (part for row in table for part in (row[:2], row[2:])):
        if (episode, number) not in frames:
            numbers = sorted(frame for name, frame in frames if name == episode)
            first = next(iter(frames), ("none", 0))[0]
            some = ", ".join(map(str, numbers[:MOST_FRAMES])) + ", …" * (len(numbers) > MOST_FRAMES)
            similar = similar_name(episode, dict.fromkeys(name for name, _ in frames))
            its = f"of that episode {some}" if numbers else f"episodes such as {similar or first!r}"
            raise UsageError(
                f"the run has no frame {number} of {episode!r}, which the table of pairs names; it has {its}"
            )


def open_session(
    run: Run,
    source: ReplayFiles,
    load: LoadPolicy | None = None,
    choice: Choice | None = None,
    table: Sequence[PairRow] = (),
    instructions: Sequence[str] = (),
) -> ReplaySession:
    """Load the run's policy and set up its observations.

    Args:
        run: Run to open again.
        source: Places of the policy, the pictures and the files.
        load: Function that loads the policy; None to load it by its name.
        choice: Settings that choose pairs of a run without sides; None for the defaults.
        table: Pairs of the user's own; empty for those of the choice. The frames that it names are looked up
            before the policy is loaded.
        instructions: Words of other tasks, which the policy must be able to read; empty for those of the choice.

    Raises:
        UsageError: For a table with a frame that the run lacks.
        InstructionError: For instructions that the policy cannot read in full.
        SettingsMismatchError: For another policy than the run's.
        SuiteError: For another suite.
        SuiteNotFoundError: For a suite that is neither given nor can be drawn again.
        SceneError: For a scene that needs a file which is not given.
    """

    def policy() -> "Policy":
        return (load or load_policy_of)(run, source)

    table = table or (() if choice is None else choice.pairs)
    check_readable(run, source, instructions or (() if choice is None else choice.instructions))
    with ExitStack() as on_failure:
        session: ReplaySession
        if run.source.is_scene:
            check_pairs(table, {(str(episode), 0) for episode in run.episodes["episode_id"]})
            session = SceneSession.of(run, source, policy)
            on_failure.callback(session.close)
        else:
            frames = Frames(run, source)
            on_failure.callback(frames.close)
            check_pairs(table, frames.by_name)
            if choice is not None:
                frames.check_varied(choice.varied, choice.instructions)
            session = FrameSession(run, policy().with_cameras(list(frames.cameras)), frames, choice)
        check_policy(run, session.policy)
        on_failure.pop_all()
    return session


def find_pairs(session: ReplaySession, category: str, items: int | None = None) -> list[Pair]:
    """Return the inferences of a category's episodes in a run, each paired with its source's.

    In the scene these are first inferences, and those before swapped images. The metric that fits is
    `session.lateral_displacement`: metres, left positive. Every clean inference is repeated and compared with the
    action that the run executed.

    Args:
        session: Session of the run.
        category: Name of the category.
        items: Number of items, both layouts of each; None for all.

    Raises:
        UnknownCategoryError: For a category that the run does not have.
        OtherFramesError: For pictures that are not those of the run.
        CaptureChangedActionError: For actions that are not those of the run.
    """
    pairs = []
    for item in items_of(session.run, (category,), items):
        for pair in session.pairs(item):
            session.replay_error(pair, session.act(pair.clean, pair.seed))
            pairs.append(pair)
    return pairs
