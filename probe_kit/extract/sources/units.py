"""Units of states and the order of actions, compared with the statistics and names of a checkpoint."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import PolicyFailedError, UnitsError
from probe_kit.hooks.checkpoints.third_party import copied, while_acting
from probe_kit.hooks.contract.observation import Observation

if TYPE_CHECKING:
    from probe_kit.hooks import Policy

MOST_UNUSUAL = 0.2
"""Share of unusual values of one number of the state, above which a run is refused."""
FIRST_EPISODES = 4
"""Episodes of a scene or environment whose first states are compared, before any is played."""


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
    worst = ", ".join(
        f"{'number ' * names[at].isdecimal()}{names[at]} in {shares[at]:.0%}"
        for at in np.flatnonzero(shares > MOST_UNUSUAL)
    )
    raise UnitsError(
        f"{where}: many states lie outside the statistics of {policy.card.checkpoint} ({worst}); "
        f"expected at most {MOST_UNUSUAL:.0%} of each number. The units or the robot differ: take a checkpoint "
        "that was trained on such states, or accept it with --accept-units"
    )


def other_order(policy: "Policy", names: Sequence[str]) -> str | None:
    """Why numbers of these names are not the actions of a policy in their order; None where nothing says so.

    Names are compared where both sides have any: positions such as `0`, `1` are none.
    """
    predicted = policy.action_names
    if predicted is None or tuple(names) == predicted or all(name.isdecimal() for name in names):
        return None
    kind = "in another order" if sorted(predicted) == sorted(names) else "otherwise"
    return (
        f"the checkpoint names its actions {', '.join(predicted)}, and they are named {kind}: {', '.join(names)}"
    )


def exchanged_names(policy: "Policy", names: Sequence[str]) -> str | None:
    """Return the reason of `other_order`, only where a name that both sides have is at another place."""
    predicted = policy.action_names or ()
    places = {name: position for position, name in enumerate(predicted)}
    moved = [name for position, name in enumerate(names) if places.get(name, position) != position]
    return other_order(policy, names) if moved else None


def predicted_once(policy: "Policy", observation: Observation) -> NDArray[np.float32]:
    """(chunk, D): one prediction of a policy, in its own units. Raises PolicyFailedError for anything else."""
    with while_acting(policy.card.family, policy.card.checkpoint):
        chunks = policy.predict(copied([observation]), [0])
        check_predictions(chunks, 1)
    chunk: NDArray[np.float32] = chunks[0]
    return chunk


def check_predictions(chunks: Any, count: int) -> None:
    """Raise PolicyFailedError unless these are (count, chunk, D) float32."""
    if not (
        isinstance(chunks, np.ndarray) and chunks.ndim == 3 and len(chunks) == count and chunks.dtype == np.float32
    ):
        described = f"{chunks.shape} {chunks.dtype}" if isinstance(chunks, np.ndarray) else type(chunks).__name__
        raise PolicyFailedError(
            f"the policy predicted {described} for {count} observations; expected float32 "
            f"({count}, chunk, actions)"
        )
