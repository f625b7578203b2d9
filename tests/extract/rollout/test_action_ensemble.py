from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.rollout.controllers import PolicyController, Turn, ensemble
from probe_kit.extract.rollout.tasks import check_reachable
from probe_kit.extract.sources.player import Row
from probe_kit.hashing import derive_seed
from probe_kit.hooks import Observation, load_policy
from probe_kit.suite import Suite
from tests.support.spatialvla_checkpoints import write_checkpoint


def chunks(*firsts: float) -> list[np.ndarray]:
    """Chunks of three actions whose x counts up from the given number."""
    return [
        np.array([[first + step, 0, 0, 0, 0, 0, first > 1] for step in range(3)], np.float32) for first in firsts
    ]


def test_every_chunk_speaks_through_the_action_it_planned_for_now() -> None:
    weights = np.exp(0.8 * np.arange(3))
    expected = (weights * [10 + 2, 20 + 1, 30]).sum() / weights.sum()
    assert ensemble(chunks(10, 20, 30), 0.8)[0] == pytest.approx(expected, rel=1e-6)
    assert ensemble(chunks(10, 20, 30), 0.0)[0] == pytest.approx((12 + 21 + 30) / 3)


def test_the_first_step_has_one_plan_and_chunks_too_old_have_none() -> None:
    np.testing.assert_array_equal(ensemble(chunks(5), 0.8), chunks(5)[0][0])
    np.testing.assert_array_equal(ensemble(chunks(1000, 10, 20, 30), 0.8), ensemble(chunks(10, 20, 30), 0.8))


def test_the_gripper_stays_open_or_closed() -> None:
    assert ensemble(chunks(2, 2, 0), 0.0)[6] == 1
    assert ensemble(chunks(2, 0, 0), 0.0)[6] == 0
    assert ensemble(chunks(2, 0), 0.8)[6] == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
def test_an_episode_is_played_by_the_mean_of_its_plans(
    tmp_path: Path, observation: Observation, small_suite: Suite
) -> None:
    checkpoint = str(write_checkpoint(tmp_path))
    policy = load_policy("spatialvla", checkpoint, ensemble="true", constrained=True, camera="default")
    asked = ExtractSettings("spatialvla", checkpoint, suite=small_suite.folder, categories=("color",), items=2)
    source = asked.source.open()
    controller = PolicyController(policy, source, asked)
    past: list[np.ndarray] = []
    planned: list[np.ndarray] = []
    for call in range(3):
        seen = replace(observation, image=np.roll(observation.image, call, axis=1))
        turn = Turn(seen, Row(0, {"policy_seed": 5}), call + 1, cast(Any, None), past)
        executed = controller.infer([turn])[0].actions
        planned.append(policy.act([seen], [derive_seed(5, "inference", call + 1)])[0])
        np.testing.assert_array_equal(executed, ensemble(planned, 0.8)[None])
    assert len(past) == 3
    asked = asked.changed(execute=2)
    with pytest.raises(UsageError, match="needs an inference per action"):
        check_reachable(asked, policy.card, source)
    check_reachable(asked.changed(execute=None), policy.card, source)
