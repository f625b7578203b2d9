"""Recordings and environments of a user's own: shown or played, captured, decoded."""

import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import probe_kit as pk
from tests.acceptance.product import probe_kit

CAMERA, FRAMES, EPISODES = "observation.images.top", 3, 6
FURTHER = 5
"""Recorded episodes that the first run does not show."""
PLAYED = 10
"""Episodes of the environment: five groups per side."""
STATE = np.array([0.29, 0.0, 0.16, 0.0, 0.0, 0.0, 0.0, 1.0], np.float32)
LAST = pk.Site("backbone", 3)

ENVIRONMENT = '''
import numpy as np
from probe_kit.extract import EnvEpisode, Step
from probe_kit.hooks import Observation


class Table:
    """A hand that the actions move over a plain table; the side of a red block depends on the seed."""

    revision = "table 1"
    action_names = ("dx", "dy", "dz", "roll", "pitch", "yaw", "grip")

    def __init__(self, count=6):
        self.count = int(count)

    def episodes(self):
        for seed in range(self.count):
            yield EnvEpisode(f"table-{seed}", seed, "Put the cube on the red shape", group=f"pair-{seed}")

    def reset(self, episode):
        self.episode, self.steps = episode, 0
        draw = np.random.default_rng(episode.seed)
        self.hand = np.array([0.29, 0.0, 0.16]) + 0.002 * draw.normal(size=3)
        self.left = bool(episode.seed % 2)
        return self.seen()

    def step(self, action):
        self.hand = self.hand + np.clip(action[:3], -0.02, 0.02)
        self.steps += 1
        return self.seen()

    def close(self):
        pass

    def seen(self):
        picture = np.full((48, 48, 3), 200, np.uint8)
        picture[20:28, 8:16 if self.left else 12] = (200, 30, 30)
        state = np.array([*self.hand, 0, 0, 0, 0, 1], np.float32)
        facts = {"left": self.left, "height": float(self.hand[2]), "success": self.steps >= 4}
        return Step(Observation(picture, state, self.episode.instruction), self.steps == 4, facts)
'''


@pytest.fixture(scope="module")
def _datasets_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No cache of the user is read or filled by the `datasets` package."""
    config = pytest.importorskip("datasets.config", reason="the extra `datasets` is not installed")
    place = tmp_path_factory.mktemp("datasets-cache")
    before = config.HF_DATASETS_CACHE, os.environ.get("HF_DATASETS_CACHE")
    config.HF_DATASETS_CACHE, os.environ["HF_DATASETS_CACHE"] = place, str(place)
    yield
    config.HF_DATASETS_CACHE = before[0]
    os.environ.pop("HF_DATASETS_CACHE")
    if before[1] is not None:
        os.environ["HF_DATASETS_CACHE"] = before[1]


@pytest.fixture(scope="module")
def recording(_datasets_cache: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven episodes of three frames and one more in odd episodes, written by lerobot's own API."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder, draw = tmp_path_factory.mktemp("recorded") / "kitchen", np.random.default_rng(0)
    features = {
        CAMERA: {"dtype": "image", "shape": (48, 64, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (8,), "names": [f"s{place}" for place in range(8)]},
        "action": {"dtype": "float32", "shape": (7,), "names": None},
    }
    data = LeRobotDataset.create("local/kitchen", 5, features, root=folder, use_videos=False)
    for episode in range(EPISODES + FURTHER):
        for frame in range(FRAMES + episode % 2):
            data.add_frame(
                {
                    CAMERA: draw.integers(0, 256, (48, 64, 3), dtype=np.uint8),
                    "observation.state": recorded_state(episode, frame),
                    "action": recorded_action(episode, frame),
                    "task": f"Put the cube on the {('red', 'gray')[episode % 2]} shape",
                }
            )
        data.save_episode()
    data.finalize()
    return folder


def recorded_state(episode: int, frame: int) -> np.ndarray:
    """A pose that differs at every frame, within the statistics of the embedded policy."""
    return (STATE + np.float32(0.001) * np.array([episode, frame, 0, 0, 0, 0, 0, 0], np.float32)).astype(
        np.float32
    )


def recorded_action(episode: int, frame: int) -> np.ndarray:
    """Small numbers that differ at every frame; the embedded policy never turns the hand."""
    return np.array([1, 1, 1, 0, 0, 0, 1], np.float32) * np.float32(0.0002 * (10 * episode + frame))


@pytest.fixture(scope="module")
def shown(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shown") / "run"
    probe_kit("extract", *recording_words(recording), "--episodes", f"0:{EPISODES}", "--out", folder)
    return folder


def recording_words(folder: Path) -> tuple[object, ...]:
    return ("--model", "pi0-tiny", "--dataset", folder, "--camera", f"base={CAMERA}")


@pytest.fixture(scope="module")
def environment_module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The module is importable by its name, as a user's own module is in its folder."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "accepted_table.py").write_text(ENVIRONMENT, encoding="utf-8")
    sys.path.insert(0, str(folder))
    yield "accepted_table:Table"
    sys.path.remove(str(folder))
    sys.modules.pop("accepted_table", None)


@pytest.fixture(scope="module")
def acted(environment_module: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("acted") / "run"
    probe_kit("extract", *environment_words(environment_module), "--out", folder)
    return folder


def environment_words(module: str, count: int = PLAYED) -> list[str]:
    played = ["--model", "pi0-tiny", "--env", module, "--env-option", f"count={count}", "--env-workers", "0"]
    return [*played, "--captured-calls", "2", "--execute", "2", "--max-steps", "5"]


def test_the_command_that_shows_a_data_set_names_its_cameras_and_tasks(recording: Path) -> None:
    text = probe_kit("dataset", "show", recording).text
    for word in (CAMERA, "gray shape", "observation.state"):
        assert word in text


def test_a_recording_is_shown_frame_by_frame_and_its_numbers_are_stored_beside_the_activations(
    shown: Path,
) -> None:
    run = pk.open_run(shown)
    assert run.recorded
    assert len(run.episodes) == EPISODES
    assert set(run.episodes["instruction"]) == {"Put the cube on the red shape", "Put the cube on the gray shape"}
    assert run.inputs is not None
    states, actions = run.inputs.read("state"), run.inputs.read("action")
    for row in range(EPISODES):
        frames = FRAMES + row % 2
        assert run.control_steps[row][:frames].tolist() == list(range(frames))
        expected = np.stack([recorded_state(row, frame) for frame in range(frames)])
        assert np.array_equal(states[row, :frames], expected)
        expected = np.stack([recorded_action(row, frame) for frame in range(frames)])
        assert np.array_equal(actions[row, :frames, 0], expected)
        for call in range(FRAMES + 1):
            assert np.isfinite(run.column(LAST, "mean", call)[row]).all() == (call < frames)
    assert np.isfinite(run.inputs.read("prediction")[:, :FRAMES]).all()


@pytest.mark.slow
def test_showing_the_same_frames_again_from_python_gives_the_same_activations(
    recording: Path, shown: Path, tmp_path: Path
) -> None:
    source = pk.LeRobotSource(str(recording), episodes=range(2), cameras={"base": CAMERA})
    again = pk.extract_run(pk.ExtractSettings("pi0-tiny", source=source), tmp_path / "again")
    for site in (LAST, pk.Site("expert", 3, iteration=9)):
        assert np.array_equal(again.column(site, "mean", 1), pk.open_run(shown).column(site, "mean", 1)[:2])


def test_errors_of_predicted_actions_are_those_of_the_stored_numbers(shown: Path) -> None:
    rows = json.loads(probe_kit("run", "show", shown, "--action-errors", "--json").out)
    assert rows
    assert "NaN" not in json.dumps(rows)


@pytest.mark.slow
def test_a_recorded_number_is_decoded_with_the_recorded_action_as_a_control(shown: Path) -> None:
    probe_kit(
        *("train", shown, "--target", "dataset.state.s1", "--permutations", "5", "--task", "continuous"),
        *("--controls", "step,state,action,instruction,pixels,random-features"),
    )
    text = probe_kit("retention", shown, "--target", "dataset.state.s1").text
    assert "dataset.state.s1" in text


@pytest.mark.slow
def test_probes_of_one_run_are_scored_on_another_with_other_episodes(
    recording: Path, shown: Path, tmp_path: Path
) -> None:
    further = ("--episodes", f"{EPISODES}:{EPISODES + FURTHER}")
    probe_kit("extract", *recording_words(recording), *further, "--out", tmp_path / "others")
    typed = ("--target", "dataset.state.s1", "--task", "continuous", "--permutations", "3")
    before = sorted(shown.rglob("settings.json"))
    text = probe_kit("train", shown, *typed, "--test-on", tmp_path / "others").text
    for word in ("chance", "recentred", "backbone"):
        assert word in text
    assert sorted(shown.rglob("settings.json")) == before, "nothing is stored"
    with_itself = probe_kit("train", shown, *typed, "--test-on", shown, code=None)
    assert with_itself.code != 0, "the groups of a run do not test its own probes"


def test_an_environment_passes_its_check_and_a_broken_one_fails_it(environment_module: str) -> None:
    assert "passed" in probe_kit("check-environment", environment_module).text.casefold()
    assert "nowhere" in probe_kit("check-environment", "nowhere:Table", code=2).text


def test_a_policy_acts_in_an_environment_and_its_facts_become_labels(acted: Path) -> None:
    run = pk.open_run(acted)
    assert run.in_own_environment
    assert len(run.episodes) == PLAYED
    assert set(run.episodes["outcome"]) == {"success"}
    for call in (0, 1):
        column = run.column(LAST, "mean", call)
        assert column.shape == (PLAYED, 96)
        assert np.isfinite(column).all()
    left = pk.Target.of_run(run, "env.left")
    assert left.task == "binary"
    table = probe_kit("labels", acted, "--out", acted.parent / "labels.csv").text
    assert "env.left" in table + (acted.parent / "labels.csv").read_text(encoding="utf-8")


@pytest.mark.slow
def test_episodes_of_an_environment_are_the_same_when_they_are_played_again(
    environment_module: str, acted: Path, tmp_path: Path
) -> None:
    probe_kit("extract", *environment_words(environment_module, 2), "--out", tmp_path / "again")
    again, run = pk.open_run(tmp_path / "again"), pk.open_run(acted)
    assert np.array_equal(again.column(LAST, "mean", 1), run.column(LAST, "mean", 1)[:2])


@pytest.mark.slow
def test_a_fact_of_the_environment_is_decoded(acted: Path) -> None:
    probe_kit(
        "train", acted, "--target", "env.left", "--permutations", "5", "--controls", "instruction,step,state"
    )
    run = pk.open_run(acted)
    results = pk.train_probes(run, target=pk.Target.of_run(run, "env.left"), permutations=5)
    assert results.scores["score"].max() <= 1
