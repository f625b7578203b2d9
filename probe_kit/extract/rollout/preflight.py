"""Checks before the first episode: a test build of the scene, units of its states, and the order of actions.

A source is a scene, a recording or an environment. States of its first inferences are compared with the statistics
of the checkpoint, and names of actions with the names that the checkpoint has.
"""

from collections.abc import Iterable, Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import Act2AnswerEnv, SceneSpec
from probe_kit.errors import SceneError, UnitsError
from probe_kit.extract.plan import PlannedEpisode

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

EPISODES = 3
"""If the scene of one episode cannot be built, so many are tried: a single one costs no run."""
MOST_UNUSUAL = 0.2
"""Share of unusual values of one number of the state, above which a run is refused."""
FIRST_EPISODES = 4
"""Episodes of a scene or environment whose first states are compared, before any is played."""


def run_preflight(scene: SceneSpec, episodes: Iterable[PlannedEpisode]) -> None:
    """Set up the first episode, or the next ones if its start cannot be reached.

    Raises SceneError if none of the first episodes can be set up, such as for an arm whose meshes are not
    installed, and SuiteError if a picture of the first one is not what the suite says.
    """
    env = Act2AnswerEnv(scene)
    failed: SceneError | None = None
    try:
        for planned in islice(episodes, EPISODES):
            try:
                env.reset(
                    seed=planned.scene_seed,
                    options={"item": planned.episode.item, "layout": planned.episode.layout},
                )
            except SceneError as error:
                failed = error
            else:
                return
    finally:
        env.close()
    if failed is not None:
        raise failed


def first_states(scene: SceneSpec, episodes: Iterable[PlannedEpisode]) -> NDArray[np.float32]:
    """(n, 8) states of the arm at the first inference of some episodes; those that cannot be set up are left out.

    Raises SceneError if none can be set up.
    """
    env = Act2AnswerEnv(scene)
    states, failed = [], None
    try:
        for planned in episodes:
            try:
                options = {"item": planned.episode.item, "layout": planned.episode.layout}
                seen, _ = env.reset(seed=planned.scene_seed, options=options)
                states.append(seen["agent_pos"])
            except SceneError as error:
                failed = error
    finally:
        env.close()
    if not states and failed is not None:
        raise failed
    return np.stack(states)


def unusual_shares(policy: "Policy", states: NDArray[np.float32]) -> NDArray[np.float64]:
    """(D,) share of the states (n, D) whose number lies far outside the checkpoint's statistics.

    Empty for a policy that normalises no state.
    """
    if policy.state_numbers is None:
        return np.zeros(0)
    shares: NDArray[np.float64] = policy.unusual_states(states).mean(axis=0)
    return shares


def check_units(
    shares: NDArray[np.float64], names: Sequence[str], where: str, policy: "Policy", accepted: bool
) -> None:
    """Raise UnitsError for states far outside the checkpoint's statistics, unless that is accepted.

    shares: (D,) of `unusual_shares`. names: of the numbers of the state. where: the source.
    """
    if accepted or not (shares > MOST_UNUSUAL).any():
        return
    worst = ", ".join(f"{names[one]} {shares[one]:.0%}" for one in np.flatnonzero(shares > MOST_UNUSUAL))
    raise UnitsError(
        f"{where}: of the states many values lie outside the statistics of {policy.card.checkpoint} ({worst}); "
        f"expected at most {MOST_UNUSUAL:.0%} of each number. The units or the robot differ: take a checkpoint "
        "that was trained on such states, or accept it with --accept-units"
    )


def other_order(policy: "Policy", names: Sequence[str]) -> str | None:
    """Why numbers of these names are not the actions of a policy in their order; None where nothing says so.

    Names are compared where both sides have any: positions such as `0`, `1` are none.
    """
    own = policy.action_names
    if own is None or tuple(names) == own or all(name.isdecimal() for name in names):
        return None
    kind = "in another order" if sorted(own) == sorted(names) else "otherwise"
    return f"the checkpoint names its actions {', '.join(own)}, and they are named {kind}: {', '.join(names)}"


def exchanged_names(policy: "Policy", names: Sequence[str]) -> str | None:
    """As `other_order`, only where a name that both sides have is at another place."""
    own = policy.action_names or ()
    places = {name: place for place, name in enumerate(own)}
    moved = [name for place, name in enumerate(names) if places.get(name, place) != place]
    return other_order(policy, names) if moved else None
