"""A policy that misbehaves costs its own episodes or nothing; other episodes keep every number."""

import json
import os
import pickle
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from probe_kit._execution.executor import WorkerLostWarning
from probe_kit._system.escaping import UNSAFE
from probe_kit.env import SceneSpec
from probe_kit.errors import (
    ActionError,
    CaptureChangedActionError,
    CheckpointError,
    EpisodesFailedError,
    PolicyFailedError,
    UsageError,
)
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.sources.player import LONGEST_TRACEBACK, add_traceback, traceback_of
from probe_kit.hooks import Observation
from probe_kit.hooks.checkpoints.third_party import contain_policy, while_acting
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0_tiny
from probe_kit.hooks.family import Family
from probe_kit.hooks.family_parts import Requirements
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from tests.support.episode_tables import without_seconds

ACT = Pi0.act
PROVED = 5
"""Inferences of the first call: three that check the inputs, then one with hooks and one without."""


@pytest.fixture(scope="module")
def settings(suite: Suite) -> ExtractSettings:
    return ExtractSettings(
        "pi0-tiny", random_weights=True, suite=suite.folder, scene=SceneSpec(max_steps=2), env_workers=0
    )


@pytest.fixture(scope="module")
def pi0_tiny() -> Pi0:
    return load_pi0_tiny(random_weights=True)


@pytest.fixture(scope="module")
def plain(settings: ExtractSettings, pi0_tiny: Pi0, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What a policy that behaves leaves."""
    return numbers(prepare(settings, model=pi0_tiny).run(tmp_path_factory.mktemp("plain") / "run"))


def numbers(run: Run) -> dict[str, str]:
    """A hash of everything stored that is read: outcomes, paths, pictures, activations."""
    rows = range(len(run.episodes))
    values: dict[str, list[Any]] = {
        "trajectories": [run.trajectory(row).frames for row in rows],
        "pictures": [np.frombuffer(path.read_bytes(), np.uint8) for path in sorted(run.path.glob("frames/*"))],
        "activations": [run.rows(stream)[row] for stream in run.streams for row in rows],
    }
    assert all(values.values())
    digests_by_name = {
        name: [sha256(array.tobytes()).hexdigest() for array in arrays] for name, arrays in values.items()
    }
    return {name: str(digests) for name, digests in digests_by_name.items()} | {
        "episodes": without_seconds(run.episodes).to_csv()
    }


def misbehave(monkeypatch: pytest.MonkeyPatch, spoil: Callable[[list[Observation], Any], Any]) -> None:
    """Let the embedded policy do something else as well at every inference."""

    def act(self: Pi0, observations: list[Observation], seeds: Any) -> Any:
        return spoil(observations, ACT(self, observations, seeds))

    monkeypatch.setattr(Pi0, "act", act)


def reseed(_: Any, chunks: Any) -> Any:
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    random.seed(1)
    return chunks


def scribble(observations: list[Observation], chunks: Any) -> Any:
    for observation in observations:
        observation.image[:] = 0
        observation.state[:] = np.nan
    return chunks


KEPT: list[Any] = []


def change_later(_: Any, chunks: Any) -> Any:
    for old in KEPT:
        old[:] = np.nan
    KEPT.append(chunks)
    return chunks


def move(_: Any, chunks: Any) -> Any:
    os.chdir("/")
    os.environ["HOME"] = "/nowhere"
    os.environ["NEW"] = "1"
    return chunks


def coarsen(_: Any, chunks: Any) -> Any:
    torch.set_default_dtype(torch.float64)
    return chunks


def deafen(_: Any, chunks: Any) -> Any:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return chunks


def fork(_: Any, chunks: Any) -> Any:
    os.fork()
    return chunks


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [reseed, scribble, change_later, move, deafen, fork])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_what_a_policy_changes_around_itself_changes_no_number_and_is_put_back(
    spoil: Any, settings: ExtractSettings, pi0_tiny: Pi0, plain: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    misbehave(monkeypatch, spoil)
    before = surroundings()
    prepare(settings, model=pi0_tiny).run("run")
    assert surroundings() == before
    assert numbers(open_run(tmp_path / "run")) == plain
    KEPT.clear()


def surroundings() -> dict[str, Any]:
    return {
        "folder": Path.cwd(),
        "variables": dict(os.environ),
        "ctrl-c": signal.getsignal(signal.SIGINT),
        "streams": (sys.stdout, sys.stderr),
    }


def everything() -> dict[str, Any]:
    return surroundings() | {
        "python": random.getstate(),
        "numpy": np.random.get_state()[1].tolist(),  # noqa: NPY002
        "torch": torch.get_rng_state().tolist(),
        "dtype": torch.get_default_dtype(),
    }


@pytest.mark.parametrize("spoil", [reseed, move, coarsen, deafen, fork])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_all_is_as_it_was_after_a_call(spoil: Any) -> None:
    before = everything()
    with while_acting("mine", "here"):
        spoil(None, None)
    assert everything() == before
    with suppress(PolicyFailedError), while_acting("mine", "here"):
        raise spoil(None, ValueError("and then this"))
    assert everything() == before


class Wild:
    """No array, and no number either."""

    shape, dtype = (1, 2, 7), np.dtype(np.float32)

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise KeyError("no array")


def press(_: Any) -> Any:
    raise KeyboardInterrupt


def generator_exit(_: Any) -> Any:
    raise GeneratorExit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (press, "failed while it acted: KeyboardInterrupt"),
        pytest.param(generator_exit, "failed while it acted: GeneratorExit", marks=pytest.mark.slow),
        pytest.param(lambda _: Wild(), "the policy gave a Wild for 1 observations", marks=pytest.mark.slow),
        pytest.param(
            lambda chunks: chunks.tolist(), "the policy gave a list for 1 observations", marks=pytest.mark.slow
        ),
        pytest.param(
            lambda chunks: torch.from_numpy(chunks),
            "the policy gave a Tensor for 1 observations",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks.astype(np.float64),
            r"ndarray of shape \(1, \d+, 7\) and float64",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks.astype(object),
            r"ndarray of shape \(1, \d+, 7\) and object",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks[:, :0], r"ndarray of shape \(1, 0, 7\) and float32", marks=pytest.mark.slow
        ),
        (lambda chunks: chunks * np.inf, "is not finite"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_an_invalid_action_fails_its_own_episode_by_name_and_no_other(
    spoil: Any, words: str, settings: ExtractSettings, plain: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    calls: list[Any] = []

    def once(_: Any, chunks: Any) -> Any:
        """The first inference of the second episode, which is tried again, and is the last one then."""
        calls.append(None)
        return spoil(chunks) if len(calls) == PROVED + 1 else chunks

    misbehave(monkeypatch, once)
    extract_run(settings, tmp_path / "once")
    assert numbers(open_run(tmp_path / "once")) == plain
    misbehave(monkeypatch, lambda _, chunks: spoil(chunks))
    with pytest.raises((EpisodesFailedError, PolicyFailedError)) as caught:
        extract_run(settings, tmp_path / "always")
    notes = getattr(caught.value, "__notes__", [str(caught.value)])
    assert all(re.search(words, note) for note in notes), notes


def test_a_policy_that_draws_from_global_numbers_is_refused(
    settings: ExtractSettings, pi0_tiny: Pi0, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    misbehave(monkeypatch, lambda _, chunks: chunks + np.float32(np.random.rand()))  # noqa: NPY002
    with pytest.raises(CaptureChangedActionError, match="not deterministic"):
        prepare(settings, model=pi0_tiny).run(tmp_path / "run")


@pytest.mark.slow
def test_what_a_policy_prints_is_text_on_stderr(
    settings: ExtractSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def shout(_: Any, chunks: Any) -> Any:
        print("\x1b[31mred\x1b]0;title\x07 \u202e")
        sys.stderr.write("\x1b[2J")
        return chunks

    misbehave(monkeypatch, shout)
    extract_run(settings, tmp_path / "run")
    output = capsys.readouterr()
    assert output.out == ""
    assert "␛[31mred␛]0;title␇ \ufffd\n␛[2J" in output.err
    assert not UNSAFE.search(output.err)


def press_ctrl_c() -> None:
    with while_acting("mine", "here"):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)


def press_nothing() -> None:
    with while_acting("mine", "here"):
        raise KeyboardInterrupt


def test_only_a_real_ctrl_c_in_a_policy_is_one() -> None:
    with pytest.raises(KeyboardInterrupt):
        press_ctrl_c()
    with pytest.raises(PolicyFailedError, match="mine failed while it acted: KeyboardInterrupt"):
        press_nothing()


HANGING = f"""
from probe_kit.hooks.families.pi0.adapter import Pi0, load_pi0_tiny
from probe_kit.hooks.family import Family

FAMILY = Family("theirs", "a family of others that hangs", None, "their_policy:load")

class Hanging(Pi0):
    calls = 0

    def act(self, seen, seeds):
        self.calls += 1
        while self.calls == {PROVED + 1}:
            pass
        return super().act(seen, seeds)

def load(*arguments, **options):
    policy = load_pi0_tiny(*arguments, **options)
    policy.__class__ = Hanging
    return policy
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package with the entry point, installed here and in every worker; the name of its family."""
    folder = tmp_path / "site"
    about = folder / "their_policy-1.0.dist-info"
    about.mkdir(parents=True)
    (folder / "their_policy.py").write_text(HANGING, encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-policy\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(
        "[probe_kit.policies]\ntheirs = their_policy:FAMILY\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(folder)
    return "theirs"


@pytest.mark.slow
def test_a_model_that_hangs_in_a_worker_is_ended_and_its_episodes_are_played_again(
    installed: str, settings: ExtractSettings, tmp_path: Path
) -> None:
    """The second episode of every worker hangs: the first one is kept, and the last ones are named."""
    hurried = settings.changed(model=installed, workers=1, inference_limit=15.0)
    warning = r"worker 0 was ended, because a call of its model took longer than --inference-limit 15 s"
    with pytest.warns(WorkerLostWarning, match=warning), suppress(EpisodesFailedError):
        extract_run(hurried, tmp_path / "run")
    assert len(open_run(tmp_path / "run", allow_partial=True).episodes) >= 2


def test_a_limit_without_a_process_that_can_be_ended_is_wrong_usage(settings: ExtractSettings) -> None:
    with pytest.raises(UsageError, match="add --workers 1"):
        settings.changed(inference_limit=5.0)
    for limit in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="inference_limit is"):
            settings.changed(workers=1, inference_limit=limit)


def test_a_limit_changes_no_name_of_a_run(settings: ExtractSettings) -> None:
    assert settings.changed(workers=1, inference_limit=5.0).identity() == settings.identity()


@pytest.mark.slow
def test_the_limit_ends_a_process_that_holds_the_interpreter() -> None:
    code = (
        "from probe_kit.hooks.checkpoints.third_party import contain_policy\n"
        "with contain_policy(0.2):\n  sum(range(10**12))"
    )
    completed = subprocess.run([sys.executable, "-c", code], check=False, timeout=120)
    assert completed.returncode == -signal.SIGALRM


def test_a_call_within_its_limit_is_not_ended_later() -> None:
    with contain_policy(0.2):
        pass
    time.sleep(0.3)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def short_settings(suite: Suite) -> ExtractSettings:
    return ExtractSettings(
        "pi0-tiny",
        random_weights=True,
        suite=suite.folder,
        scene=SceneSpec(max_steps=2),
        env_workers=0,
        frames="none",
    )


def leave(_: Any) -> Any:
    sys.exit(0)


def fall(_: Any) -> Any:
    raise KeyError("no such thing")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (leave, r"PolicyFailedError: pi0-tiny failed while it acted: it called sys.exit\(0\)"),
        (fall, "PolicyFailedError: pi0-tiny failed while it acted: KeyError: 'no such thing'"),
        (lambda chunks: chunks * np.nan, r"ActionError: action .* is not finite \(NaN or infinity\)"),
        pytest.param(
            lambda _: None,
            "PolicyFailedError: the policy gave a NoneType for 1 observations",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks[:, :, :6],
            r"PolicyFailedError: the policy gave a ndarray of shape \(1, \d+, 6\)",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda chunks: chunks[0],
            "PolicyFailedError: the policy gave a ndarray of shape",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["exit", "error", "NaN", "None", "too short", "no batch"],
)
def test_what_a_policy_does_wrong_gives_its_episodes_up_by_name(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Any, words: str
) -> None:
    act, calls = Pi0.act, iter(range(1000))

    def spoiled(self: Pi0, *arguments: Any) -> Any:
        chunks = act(self, *arguments)
        return chunks if next(calls) < PROVED else spoil(chunks)

    monkeypatch.setattr(Pi0, "act", spoiled)
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(short_settings(suite), tmp_path / "run")
    assert len(caught.value.__notes__) == 3
    from re import search

    assert all(search(words, note) for note in caught.value.__notes__), caught.value.__notes__
    assert all("a2a-embedded-color" in note for note in caught.value.__notes__)
    assert len(open_run(tmp_path / "run", allow_partial=True).episodes) == 1


@pytest.mark.slow
def test_a_failure_is_stored_with_the_traceback_of_the_policys_own_code(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    act, calls = Pi0.act, iter(range(1000))
    monkeypatch.setattr(Pi0, "act", lambda *args: (fall if next(calls) >= PROVED else lambda a: act(*a))(args))
    with pytest.raises(EpisodesFailedError) as caught:
        extract_run(short_settings(suite), tmp_path / "run")
    files = sorted((tmp_path / "run" / "failed").iterdir())
    assert len(files) == 3
    for file, note in zip(files, caught.value.__notes__, strict=True):
        assert str(file) in note
        record = json.loads(file.read_text(encoding="utf-8"))
        assert "in fall\n" in record["traceback"]
        assert record["traceback"].rstrip().endswith(record["reason"].split(": ", 1)[1])
        assert record["reason"] in open_run(tmp_path / "run", allow_partial=True).failed.values()


def test_an_error_of_another_process_keeps_the_traceback_of_that_process() -> None:
    try:
        raise ActionError("out of bounds")
    except ActionError as error:
        add_traceback(error)
        received = pickle.loads(pickle.dumps(error))
    assert received.__traceback__ is None
    assert Path(__file__).name in traceback_of(received)
    assert len(traceback_of(ActionError("x" * 100_000))) == LONGEST_TRACEBACK


def exiting_loader(*_: Any) -> Any:
    sys.exit(0)


def raising_loader(*_: Any) -> Any:
    return {}["hidden_size"]


@pytest.mark.parametrize(
    ("loader", "error", "words"),
    [
        ("exiting_loader", PolicyFailedError, r"mine cannot be loaded: its code called sys.exit\(0\)"),
        ("raising_loader", CheckpointError, "mine cannot be loaded from what it brings: KeyError: 'hidden_size'"),
        ("no_loader", CheckpointError, "mine cannot be loaded from .*AttributeError"),
    ],
)
def test_a_family_that_cannot_load_says_so_by_name(loader: str, error: type[Exception], words: str) -> None:
    module = sys.modules[__name__]
    sys.modules["their_family"] = module
    family = Family("mine", "theirs", None, f"their_family:{loader}")
    try:
        with pytest.raises(error, match=words):
            family.load(None)
    finally:
        del sys.modules["their_family"]


def test_a_family_that_is_wrong_about_itself_breaks_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    from probe_kit.extract.inspect_commands import _model_rows
    from probe_kit.hooks import registry

    broken = Family(
        "mine",
        "theirs",
        None,
        "x:y",
        requirements=Requirements(packages=(("nowhere.at.all", "extra"),)),
    )
    entry = SimpleNamespace(name="mine", value="x:y", load=lambda: broken, dist=None)
    monkeypatch.setattr(registry, "family_entries", lambda: [entry])
    (row,) = _model_rows("mine")
    assert "unknown: " in row["ready"]
    rows = {row["model"]: row["ready"] for row in _model_rows(None)}
    assert rows["mine"] == "?"
    assert rows["pi0-tiny"] == "yes"
