"""One episode from reset to outcome."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from probe_kit.errors import ProbeKitError
from probe_kit.extract.controllers import Capture, Controller
from probe_kit.suite import Episode

if TYPE_CHECKING:
    from probe_kit.env import Act2AnswerEnv


@dataclass(frozen=True)
class Rollout:
    """What one episode left: its outcome record, the captures, and its frames if they were asked for."""

    outcome: dict[str, Any]
    captured: list[Capture]
    frames: list[NDArray[np.uint8]]


def roll_out(
    env: "Act2AnswerEnv", controller: Controller, episode: Episode, scene_seed: int, policy_seed: int, film: bool
) -> Rollout:
    """Run one episode to its end.

    scene_seed decides where the cube starts; policy_seed all randomness of the policy.
    film: keep a frame per action (slow).
    A ProbeKitError that escapes carries a note naming the episode.
    """
    try:
        _, start = env.reset(seed=scene_seed, options={"item": episode.item, "layout": episode.layout})
        controller.begin(env, episode, policy_seed)
        frames = [env.render()] if film else []
        ended = False
        while not ended:
            for action in controller.next_actions():
                _, terminated, truncated, _ = env.advance(action)
                ended = terminated or truncated
                if film:
                    frames.append(env.render())
                if ended:
                    break
    except ProbeKitError as error:
        error.add_note(f"in episode {episode.episode_id} ({episode.item.instruction!r})")
        raise
    return Rollout(_record(env, start["tile_visibility"]), controller.captured, frames)


def _record(env: "Act2AnswerEnv", tile_visibility: dict[str, float]) -> dict[str, Any]:
    """The outcome as flat columns, beside those the plan already has."""
    outcome = env.outcome().to_json()
    x, y = outcome.pop("cube_xy")
    return {
        "outcome": outcome.pop("zone"),
        "cube_x": x,
        "cube_y": y,
        **{key: value for key, value in outcome.items() if key not in ("layout", "side_correct")},
        **{f"visible_{side}": share for side, share in tile_visibility.items()},
    }
