import numpy as np
import pytest
import torch
from torch import Tensor

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.models.internvla import InternVLANetwork, Schedule
from tests.support.internvla_checkpoints import network


@pytest.fixture(scope="module")
def built() -> InternVLANetwork:
    return network()


@pytest.mark.parametrize(("steps", "moments"), [(5, [0, 20, 40, 60, 80]), (10, list(range(0, 100, 10)))])
def test_steps_lie_at_a_whole_distance(steps: int, moments: list[int]) -> None:
    schedule = Schedule.of(steps, 100)
    assert schedule.moments.tolist() == moments
    assert len(schedule) == steps


def test_the_signal_falls_as_a_squared_cosine() -> None:
    signal = Schedule.of(100, 100).signal
    share = (np.arange(1, 101) / 100 + 0.008) / 1.008
    np.testing.assert_allclose(
        signal[:90], np.cos(share[:90] * np.pi / 2) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2
    )
    assert (np.diff(signal) < 0).all()


def test_a_number_of_steps_without_a_whole_distance_is_refused() -> None:
    with pytest.raises(UsageError, match="60 DDIM steps"):
        Schedule.of(60, 100)
    with pytest.raises(CheckpointError, match="linear"):
        Schedule.of(5, 100, "linear")


def test_true_noise_leads_back_to_the_signal_it_was_added_to() -> None:
    schedule = Schedule.of(5, 100)
    clean, noise = torch.randn(2, 4, 7), torch.randn(2, 4, 7)
    path = schedule.signal[-1] ** 0.5 * clean + (1 - schedule.signal[-1]) ** 0.5 * noise
    for index in reversed(range(5)):
        path = schedule.back(index, path, noise)
    torch.testing.assert_close(path, clean, rtol=0, atol=1e-4)


def rows_of(built: InternVLANetwork, condition: Tensor, noise: Tensor, scale: float) -> tuple[Tensor, list[int]]:
    seen: list[int] = []
    handle = built.head.register_forward_pre_hook(lambda _, given: seen.append(len(given[0])))
    try:
        return built.denoise(condition, noise, Schedule.of(5, 100), scale), seen
    finally:
        handle.remove()


@torch.inference_mode()
def test_guidance_runs_both_halves_and_mixes_them(built: InternVLANetwork) -> None:
    condition, noise = torch.randn(2, 6, 32), torch.randn(2, 4, 7)
    mixed, seen = rows_of(built, condition, noise, 1.5)
    assert seen == [4] * 5
    schedule, path = Schedule.of(5, 100), noise
    nothing = built.head.z_embedder.uncondition.expand(2, -1, -1)
    for index in reversed(range(5)):
        moment = torch.full((2,), int(schedule.moments[index]))
        without, found = built.head(path, moment, nothing), built.head(path, moment, condition)
        path = schedule.back(index, path, without + 1.5 * (found - without))
    torch.testing.assert_close(mixed, path, rtol=0, atol=2e-5)


@torch.inference_mode()
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_without_guidance_only_the_conditional_rows_run(built: InternVLANetwork, scale: float) -> None:
    plain, seen = rows_of(built, torch.randn(2, 6, 32), torch.randn(2, 4, 7), scale)
    assert seen == [2] * 5
    assert torch.isfinite(plain).all()
