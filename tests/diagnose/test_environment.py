"""A diagnosis of a policy in an environment of the user's own, where the state varies too."""

from pathlib import Path

import pytest

from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.extract import EnvironmentSettings, ExtractSettings, extract_run
from probe_kit.runs import Run
from tests.support.reach_env import Reach, ReachEnv


class Dark(Reach):
    """The camera shows one picture."""

    def _observation(self) -> dict[str, object]:
        observation = super()._observation()
        observation["pixels"][:] = 7
        return observation


class DarkEnv(ReachEnv):
    """`Dark` behind the contract."""

    def __init__(self) -> None:
        super().__init__()
        self._env = Dark()


def played(name: str, folder: Path) -> Run:
    source = EnvironmentSettings(f"{__name__}:{name}", max_steps=1)
    return extract_run(ExtractSettings("pi0-tiny", source=source, env_workers=0, execute=1), folder / "run")


@pytest.mark.slow
def test_words_pictures_and_state_of_an_environment_are_told_apart(tmp_path: Path) -> None:
    diagnosis = diagnose_run(played("ReachEnv", tmp_path), frames=12, inside=False)
    assert [diagnosed.name for diagnosed in diagnosis.inputs] == ["instruction", "picture", "state"]
    assert all(diagnosed.matters is not None for diagnosed in diagnosis.inputs)
    assert all(diagnosed.arrives for diagnosed in diagnosis.inputs)
    assert diagnosis.n_groups == 6


@pytest.mark.slow
def test_a_camera_that_shows_one_picture_is_not_varied_and_the_other_inputs_are_tested(tmp_path: Path) -> None:
    diagnosis = diagnose_run(played("DarkEnv", tmp_path), frames=12, inside=False)
    verdicts = {diagnosed.name: diagnosed.verdict for diagnosed in diagnosis.inputs}
    assert verdicts["picture"] == "not varied"
    assert verdicts["instruction"] != "not varied"
    assert verdicts["state"] != "not varied"
