"""Opening the session of a run, and the pairs of one category."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from probe_kit.intervene.pairs import Pair, check_pairs
from probe_kit.intervene.sessions.frames import Frames
from probe_kit.intervene.sessions.observed import ObservedSession
from probe_kit.intervene.sessions.scene import SceneSession
from probe_kit.intervene.sessions.session import (
    LoadPolicy,
    ReplaySession,
    ReplaySource,
    check_policy,
    load_policy_of,
)
from probe_kit.intervene.settings import PairChoice, PairRow, has_sides, items_of
from probe_kit.runs import Run

if TYPE_CHECKING:
    from probe_kit.hooks import Policy


def open_session(
    run: Run,
    source: ReplaySource,
    load: LoadPolicy | None = None,
    choice: PairChoice | None = None,
    table: Sequence[PairRow] = (),
) -> ReplaySession:
    """Load the run's policy and set up its observations.

    load: how the policy is found, if not by its name. choice: of pairs of a run without sides. table: pairs of the
    user's own, by default those of the choice; the frames that it names are looked up before the policy is loaded.
    Raises SettingsMismatchError if it is another one, SuiteError for another suite, SuiteNotFoundError for one
    that is neither given nor can be drawn again, SceneError for a scene that needs a file which is not given,
    UsageError for a table with a frame that the run lacks.
    """

    def policy() -> "Policy":
        return (load or load_policy_of)(run, source)

    table = table or (() if choice is None else choice.pairs)
    with ExitStack() as on_failure:
        session: ReplaySession
        if has_sides(run):
            check_pairs(table, {(str(episode), 0) for episode in run.episodes["episode_id"]})
            session = SceneSession.of(run, source, policy)
            on_failure.callback(session.close)
        else:
            frames = Frames(run, source)
            on_failure.callback(frames.close)
            check_pairs(table, frames.by_name)
            if choice is not None:
                frames.check_varied(choice.varied)
            session = ObservedSession(run, policy().with_cameras(list(frames.cameras)), frames, choice)
        check_policy(run, session.policy)
        on_failure.pop_all()
    return session


def find_pairs(session: ReplaySession, category: str, items: int | None = None) -> list[Pair]:
    """Return the inferences of a category's episodes in a run, each paired with its source's.

    In the scene these are first inferences, and those before swapped images; the metric that fits is
    `session.lateral_displacement`: metres, left positive. items: how many items, both layouts of each; None for
    all. Every clean inference is repeated and compared with the action that the run executed. Raises
    UnknownCategoryError for a category that the run does not have, OtherFramesError and CaptureChangedActionError
    for pictures or actions that are not those of the run.
    """
    pairs = []
    for item in items_of(session.run, (category,), items):
        for pair in session.pairs(item):
            session.replay_error(pair, session.act(pair.clean, pair.seed))
            pairs.append(pair)
    return pairs
