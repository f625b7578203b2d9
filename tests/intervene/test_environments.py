"""Interventions on runs of an environment: pairs of first observations that differ in one input."""

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from probe_kit.errors import CaptureChangedActionError, OtherFramesError, SettingsMismatchError, UsageError
from probe_kit.extract import EnvironmentSettings, ExtractSettings, prepare
from probe_kit.extract.config_files import moved_of
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.extract.sources.environment_source import open_environment
from probe_kit.hashing import derive_seed
from probe_kit.hooks import AttentionCut, Observation, cut_attention
from probe_kit.hooks.contract.sites import HEADS
from probe_kit.intervene import (
    AttentionReadout,
    ImageSwap,
    InstructionSwap,
    Interchange,
    Knockout,
    run_intervention,
)
from probe_kit.intervene.frame_session import FrameSession
from probe_kit.intervene.open_session import open_session
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run, open_run

if TYPE_CHECKING:
    from probe_kit.hooks.families.pi0.adapter import Pi0

EPISODES = 6


@pytest.fixture(scope="module", autouse=True)
def _own_modules() -> Iterator[None]:
    """The module `reach_env` can be imported by its name, as a user's own module can."""
    folder = str(Path(__file__).parents[1] / "support")
    sys.path.append(folder)
    yield
    sys.path.remove(folder)


@pytest.fixture(scope="module")
def pi0_tiny(two_steps: Path) -> "Pi0":
    from probe_kit.hooks.families.pi0.adapter import load_pi0_tiny

    return load_pi0_tiny(str(two_steps))


@pytest.fixture(scope="module")
def played(_own_modules: None, pi0_tiny: "Pi0", tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Six episodes in three groups, whose block and colour differ by the seed."""
    source = EnvironmentSettings("reach_env:ReachEnv", max_steps=6, options={"count": str(EPISODES)})
    settings = ExtractSettings("pi0-tiny", source=source, captured_calls=2, execute=3, env_workers=0, batch=1)
    folder = tmp_path_factory.mktemp("played") / "run"
    prepare(settings, model=pi0_tiny).run(folder)
    return open_run(folder)


@pytest.fixture
def session(played: Run, pi0_tiny: "Pi0") -> Iterator[FrameSession]:
    with open_session(played, ReplayFiles(), lambda *_: pi0_tiny, ImageSwap()) as opened, opened.ready():
        assert isinstance(opened, FrameSession)
        yield opened


@pytest.mark.slow
def test_a_pair_has_the_picture_of_another_group_and_all_else_of_its_own(session: FrameSession) -> None:
    for item in session.items:
        for pair in session.pairs(item):
            clean, source, donor = pair.clean, pair.source, pair.donor
            assert isinstance(clean, Observation)
            assert isinstance(source, Observation)
            assert isinstance(donor, Observation)
            np.testing.assert_array_equal(source.image, donor.image)
            assert not np.array_equal(source.image, clean.image)
            np.testing.assert_array_equal(source.state, clean.state)
            assert source.instruction == clean.instruction


@pytest.mark.slow
def test_the_first_action_of_every_episode_is_inferred_again_bit_for_bit(
    played: Run, session: FrameSession
) -> None:
    assert played.inputs is not None
    actions = played.inputs.read("action")
    for item in session.items:
        for pair in session.pairs(item):
            chunk = session.act(pair.clean, pair.seed)
            assert session.replay_error(pair, chunk) == 0
            np.testing.assert_array_equal(chunk[:3], actions[pair.row, 0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("intervention", "rows"),
    [
        (ImageSwap(), 1),
        (InstructionSwap(), 1),
        (ImageSwap(vary="state"), 1),
        (Interchange(sites=("backbone.01", "kv.*"), roles=("image",)), 4),
        (AttentionReadout(roles=("image",)), None),
    ],
)
def test_kinds_work_in_an_environment_and_are_read_again(
    played: Run, pi0_tiny: "Pi0", intervention: ImageSwap, rows: int | None
) -> None:
    result = run_intervention(played, intervention, load=lambda *_: pi0_tiny)
    assert result.certificate["replay"]["equal"] == EPISODES
    assert len(result.effects) == rows or rows is None
    assert result.verdicts == {}
    assert run_intervention(played, intervention, load=not_loaded).to_csv() == result.to_csv()


def not_loaded(*_: object) -> "Pi0":
    raise AssertionError("it is stored")


def test_an_input_of_the_environment_moves_the_action_and_patches_are_shares_of_its_exchange(
    played: Run, pi0_tiny: "Pi0"
) -> None:
    """All that the acting stream reads of the picture carries no more than the exchange of the picture."""
    swapped = run_intervention(played, ImageSwap(), load=lambda *_: pi0_tiny)
    (swap,) = swapped.effects
    assert swapped.certificate["replay"]["equal"] == EPISODES
    assert run_intervention(played, ImageSwap(), load=not_loaded).to_csv() == swapped.to_csv()
    assert swap.changed == 1
    assert swap.size > swap.control_size
    first = Interchange(sites=("backbone.00",), roles=("image",))
    (row,) = run_intervention(played, first, load=lambda *_: pi0_tiny).effects
    assert row.action_share == pytest.approx(1.0, abs=1e-3), "only the picture differs, and all of it is patched"


def test_another_version_of_the_environment_is_refused(
    played: Run, pi0_tiny: "Pi0", monkeypatch: pytest.MonkeyPatch
) -> None:
    import reach_env  # type: ignore[import-not-found]

    monkeypatch.setattr(reach_env.ReachEnv, "revision", "reach 2")
    with pytest.raises((OtherFramesError, SettingsMismatchError), match="reach 2"):
        open_session(played, ReplayFiles(), lambda *_: pi0_tiny)


@pytest.mark.slow
def test_an_environment_whose_module_was_moved_is_given_by_the_option_of_extract(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pi0_tiny: "Pi0"
) -> None:
    """The module is imported by its old name and place once, then it lies elsewhere under another name."""
    text = (Path(__file__).parents[1] / "support" / "reach_env.py").read_text(encoding="utf-8")
    for folder, name in (("old", "hand_env"), ("new", "hand_moved")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path / "old"))
    source = EnvironmentSettings("hand_env:ReachEnv", max_steps=1, options={"count": "6"})
    settings = ExtractSettings("pi0-tiny", source=source, execute=1, env_workers=0, batch=1)
    prepare(settings, model=pi0_tiny).run(tmp_path / "run")
    run = open_run(tmp_path / "run")
    shutil.rmtree(tmp_path / "old")
    monkeypatch.delitem(sys.modules, "hand_env")
    with pytest.raises(UsageError, match=r"environment, which is not here any more. Give it with --env"):
        open_session(run, ReplayFiles(), lambda *_: pi0_tiny)
    monkeypatch.syspath_prepend(str(tmp_path / "new"))
    moved = moved_of(run, {"env": "hand_moved:ReachEnv", "device": "cpu"})
    with open_session(run, ReplayFiles(moved=moved), lambda *_: pi0_tiny) as opened:
        assert isinstance(opened, FrameSession)
        assert len(opened.frames.index) == len(run.episodes)
    with pytest.raises(UsageError, match=r"--dataset does not apply: .* is given with --env, --env-option"):
        moved_of(run, {"dataset": tmp_path})


def test_a_mistyped_camera_and_an_unknown_frame_are_refused_before_the_model_is_loaded(played: Run) -> None:
    with pytest.raises(UsageError, match=r"vary is 'picture.wrist'; expected one of instruction, picture,"):
        open_session(played, ReplayFiles(), not_loaded, ImageSwap(vary="picture.wrist"))
    with pytest.raises(UsageError, match=r"no frame 1 of 'reach-00'.* it has of that episode 0"):
        open_session(played, ReplayFiles(), not_loaded, ImageSwap(pairs=(("reach-00", 1, "reach-01", 0),)))


def test_fewer_episodes_than_the_run_has_are_refused(played: Run, pi0_tiny: "Pi0") -> None:
    with pytest.raises(OtherFramesError, match="has no episode 'reach-04' any more"):
        open_session(played, ReplayFiles(moved={"options": {"count": "4"}}), lambda *_: pi0_tiny)


# -- whole episodes ------------------------------------------------------------------------------------------


def run_of(environment: str, folder: Path, policy: "Pi0", count: int) -> Run:
    source = EnvironmentSettings(f"reach_env:{environment}", max_steps=6, options={"count": str(count)})
    settings = ExtractSettings("pi0-tiny", source=source, captured_calls=2, execute=3, env_workers=0, batch=1)
    prepare(settings, model=policy).run(folder)
    return open_run(folder)


@pytest.fixture(scope="module")
def nearing(_own_modules: None, pi0_tiny: "Pi0", tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Six episodes in three groups, which succeed if the hand comes nearer."""
    return run_of("Nearing", tmp_path_factory.mktemp("nearing") / "run", pi0_tiny, EPISODES)


def succeeds(run: Run, policy: "Pi0", row: int, is_cut: bool) -> bool:
    """Play an episode by the contract alone, with the picture cut in all layers, and say how it ends."""
    environment = open_environment(EnvironmentSettings("reach_env:Nearing", options={"count": str(EPISODES)}))
    episode = list(environment.episodes())[row]
    step, call = environment.reset(episode), 0
    assert not isinstance(step, Observation)
    for call in range(2):
        seed = derive_seed(int(run.episodes["policy_seed"].iloc[row]), "inference", call)
        keys = policy.roles([step.observation])["backbone"][0].mask("image")
        cuts = dict.fromkeys(policy.streams["expert"].sites(HEADS), AttentionCut(keys)) if is_cut else {}
        with torch_threads(1), cut_attention(policy, cuts):
            chunk = policy.predict([step.observation], [seed])[0]
        for action in chunk[:3]:
            step = environment.step(action)
    environment.close()
    return bool(step.facts["success"])


@pytest.mark.slow
def test_a_cut_in_closed_loop_plays_the_environment_and_counts_success(nearing: Run, pi0_tiny: "Pi0") -> None:
    intervention = Knockout(roles=("image",), window="3", controls=1, closed_loop=True)
    result = run_intervention(nearing, intervention, load=lambda *_: pi0_tiny)
    assert result.certificate["replay"]["equal"] == result.certificate["replay"]["outcomes_equal"] == EPISODES
    cut = next(row for row in result.effects if not row.is_control)
    rows = range(EPISODES)
    assert cut.success == np.mean([succeeds(nearing, pi0_tiny, row, is_cut=True) for row in rows])
    assert cut.success_clean == np.mean([succeeds(nearing, pi0_tiny, row, is_cut=False) for row in rows])
    assert cut.success_clean == (nearing.episodes["outcome"] == "success").mean()
    assert cut.lost == pytest.approx(cut.success_clean - cut.success)
    assert cut.success_clean > 0
    assert "percentage points: success " in result.sentences[0]
    assert result.findings == (
        "All  unknown: with 3 groups of items no p can be below 0.12; 5 groups or more can show what is read.",
    )
    again = run_intervention(nearing, intervention, load=not_loaded)
    assert again.to_csv() == result.to_csv()


@pytest.mark.slow
def test_an_environment_that_says_no_success_and_an_episode_that_ends_otherwise_are_refused(
    pi0_tiny: "Pi0", nearing: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import reach_env

    without = run_of("Unjudged", tmp_path / "run", pi0_tiny, 4)
    with pytest.raises(UsageError, match=r"counts the fact 'success', and the environment of .* has block, left"):
        Knockout(closed_loop=True).check_run(without)
    monkeypatch.setattr(reach_env.Nearing, "_as_step", reach_env.ReachEnv._as_step)
    with pytest.raises(CaptureChangedActionError, match="played again with nothing changed, ended failure"):
        run_intervention(nearing, Knockout(closed_loop=True, controls=2), load=lambda *_: pi0_tiny)
