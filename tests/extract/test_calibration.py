"""`--batch auto`: what it chooses from what it measured, and that nothing stored depends on it."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.rollout import calibration
from probe_kit.extract.rollout.calibration import choose, inference_times, largest_batch
from probe_kit.extract.rollout.controllers import PolicyController
from probe_kit.runs import open_run
from probe_kit.suite import Suite

SHORT = SceneSpec(max_steps=2)


@pytest.mark.parametrize(
    ("inference", "turn", "cores", "batch", "waits"),
    [
        ({1: 0.1, 2: 0.1, 4: 0.1, 8: 0.2}, 0.01, 16, 4, 0),  # free up to four
        ({1: 0.1, 2: 0.2, 4: 0.4}, 0.01, 16, 1, 0),  # a batch brings nothing
        ({1: 0.1, 2: 0.102}, 0.1, 2, 1, 0),  # one core simulates: no batch helps it
        ({1: 0.01, 2: 0.01, 4: 0.01}, 0.1, 5, 4, 0.9),  # four simulators for one quick model
        ({1: 0.1}, 0.1, 1, 1, 0.5),  # one core does both
    ],
)
def test_the_smallest_batch_near_the_best_rate_is_chosen(
    inference: dict[int, float], turn: float, cores: int, batch: int, waits: float
) -> None:
    found = choose(inference, turn, cores)
    assert found.batch == batch
    assert found.waits == pytest.approx(waits)
    assert found.env_workers == (2 * batch if cores > 1 else 0)
    assert f"batch {batch}" in found.words


def test_batches_are_tried_up_to_the_bound_and_no_further_than_memory() -> None:
    tried: list[int] = []
    assert set(inference_times(tried.append, 1)) == {1}
    assert set(tried) == {1}

    def small(batch: int) -> None:
        if batch > 1:
            raise MemoryError

    assert set(inference_times(small, 8)) == {1}
    with pytest.raises(MemoryError):
        inference_times(lambda batch: small(batch + 1), 8)


@pytest.mark.parametrize(
    ("of_card", "episodes", "most"),
    [(1, 3440, 1), (None, 3440, 64), (8, 3440, 8), (None, 6, 3), (None, 1, 1)],
)
def test_the_card_bounds_what_is_tried(of_card: int | None, episodes: int, most: int) -> None:
    assert largest_batch(of_card, episodes) == most


@pytest.mark.slow
def test_a_policy_that_takes_one_observation_is_calibrated_to_the_same_bytes(
    small_suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its card says that batches change its numbers; whatever the times are, it gets single observations."""
    monkeypatch.setattr(calibration, "cores_here", lambda: 1)  # no processes: their start takes longer than this
    settings = ExtractSettings("pi0-tiny", suite=small_suite.folder, scene=SHORT, items=2, env_workers=0)
    plain = extract_run(settings, tmp_path / "plain")
    asked = settings.changed(env_workers=None, batch="auto")
    run_preflight, tried = PolicyController.run_preflight, set[int]()

    def counted(controller: PolicyController, observations: list, seeds: list) -> None:  # type: ignore[type-arg]
        tried.add(len(observations))
        run_preflight(controller, observations, seeds)

    monkeypatch.setattr(PolicyController, "run_preflight", counted)
    monkeypatch.setattr(calibration, "largest_batch", lambda _of_card, episodes: largest_batch(1, episodes))
    extraction = prepare(asked, tmp_path / "run")
    assert tried == {1}
    assert extraction.calibration is not None
    assert (extraction.settings.machine.batch, extraction.settings.machine.env_workers) == (1, 0)
    extraction.run(tmp_path / "run")
    for key in plain.location.keys("commits"):
        assert open_run(tmp_path / "run").location.read(key) == plain.location.read(key)


def test_what_it_chooses_is_refused_beside_it(small_suite: Suite) -> None:
    asked = ["extract", "--model", "pi0-tiny", "--suite", str(small_suite.folder), "--batch", "auto", "--dry-run"]
    result = CliRunner().invoke(app, [*asked, "--env-workers", "2"])
    assert (result.exit_code, "leave out --env-workers" in " ".join(result.output.split())) == (2, True)
    assert CliRunner().invoke(app, [*asked[:-2], "many"]).exit_code == 2
    with pytest.raises(UsageError, match="scripted"):
        prepare(ExtractSettings("expert", suite=small_suite.folder, batch="auto"))
