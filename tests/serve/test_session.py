"""Episodes of clients, the rules that bound them, and the run that they make."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import ObservationError, PolicyFailedError, SettingsMismatchError, UnitsError, UsageError
from probe_kit.extract import ExtractSettings
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.hashing import derive_seed
from probe_kit.hooks import Policy
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.frame_session import Frames
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import Run, open_run
from probe_kit.runs.environment_success import bounds_of
from probe_kit.runs.verify import verify_run
from probe_kit.serve import session as sessions
from probe_kit.serve.marks import Mark
from probe_kit.serve.server import Server, open_server
from probe_kit.serve.session import Client, Line
from probe_kit.train.target import Target
from tests.support.served_sessions import WORDS, Opens, observation

OTHER = "put the cube on the blue shape"


def written(server: Server) -> Run:
    """The run of what was played so far; sealing it would cost more than playing."""
    server.session.wait()
    return open_run(server.plan.location, allow_partial=True)


def play(server: Server, client: Client, name: str, numbers: list[int], **facts: Any) -> list[np.ndarray]:
    answers = [
        server.session.answer(client, observation(number), Mark(name, step=5 * call))
        for call, number in enumerate(numbers)
    ]
    server.session.end(client, Mark(end=True, facts=facts))
    return answers


def test_answers_are_those_of_the_policy_and_the_run_shows_them_again(opened: Opens, policy: Policy) -> None:
    lines: list[Line] = []
    server = opened(lines=lines)
    client = server.session.connect("arm-1")
    answers = play(server, client, "task/0", [0, 1, 2], success=True, score=0.5)
    play(server, client, "task/1", [3], success=False)
    assert server.close() is not None

    for call, answer in enumerate(answers):
        sent = observation(call)
        observed = Observation(sent["observation/image"], sent["observation/state"].astype(np.float32), WORDS)
        seed = derive_seed(derive_seed(0, "policy", "task/0"), "inference", call)
        with torch_threads(1):  # as a server of a small policy infers
            assert policy.predict([observed], [seed])[0].tobytes() == answer.tobytes()

    run = open_run(server.plan.location)
    assert run.sealed
    assert verify_run(run.location, deep=True).problems == ()
    assert run.episodes["outcome"].tolist() == ["success", "failure"]
    assert run.episodes["inferences"].tolist() == [3, 1]
    assert run.episodes[["began", "ended"]].to_numpy().tolist() == [["said", "said"]] * 2
    assert run.control_steps.tolist() == [[0, 5], [0, -1]]
    assert run.inputs is not None
    assert (run.inputs.row("picture.base", 0)[1] == observation(1)["observation/image"]).all()
    assert Target.of_run(run, "env.success").coded.classes == ("False", "True")
    assert np.nanmax(Target.of_run(run, "dataset.state.0").coded.values) < 1
    assert run.certificate["hooks_on_equals_hooks_off"]
    assert "observation/wrist_image" in run.certificate["served"]["never_read"]
    assert [(line.episode, line.captured, line.inferences) for line in lines] == [
        ("task/0", 2, 3),
        ("task/1", 1, 1),
    ]

    frames = Frames(run, ReplayFiles())
    for frame in frames.index:
        assert frame.stored is not None
        with torch_threads(1):
            assert policy.predict([frame.observation], [frame.seed])[0].tobytes() == frame.stored.tobytes()


@pytest.mark.slow
def test_episodes_are_the_same_whoever_else_asks(opened: Opens) -> None:
    """Six episodes by one client, by three at once, and by two in the opposite order of arrival."""
    names = [f"task/{number}" for number in range(6)]

    def ask(server: Server, client: Client, name: str, call: int) -> None:
        number = 2 * int(name[-1]) + call
        server.session.answer(client, observation(number), Mark(name, step=5 * call))

    def end(server: Server, client: Client) -> None:
        server.session.end(client, Mark(end=True))

    alone, at_once, opposite = opened("alone"), opened("at-once"), opened("opposite")
    client = alone.session.connect()
    for name in names:
        for call in range(2):
            ask(alone, client, name, call)
        end(alone, client)
    three = [at_once.session.connect() for _ in range(3)]
    for at in (0, 3):
        for call in range(2):
            for client, name in zip(three, names[at : at + 3], strict=True):
                ask(at_once, client, name, call)
        for client in three:
            end(at_once, client)
    two = [opposite.session.connect(f"arm-{number}") for number in range(2)]
    for at in (4, 2, 0):
        for call in range(2):
            for client, name in zip(two, names[at : at + 2][::-1], strict=True):
                ask(opposite, client, name, call)
        for client in two:
            end(opposite, client)

    bytes_of = []
    for server in (alone, at_once, opposite):
        run = written(server)
        assert run.inputs is not None
        by_id = {name: row for row, name in enumerate(run.episodes["episode_id"])}
        assert by_id.keys() == set(names)
        activations = [run.rows(stream) for stream in run.streams]
        of_ids = [[array[by_id[name]].tobytes() for array in activations] for name in names]
        predictions = [run.inputs.row("prediction", by_id[name]).tobytes() for name in names]
        bytes_of.append((of_ids, predictions))
    assert bytes_of[0] == bytes_of[1] == bytes_of[2]


@pytest.mark.slow
def test_an_id_that_comes_again_is_another_trial_and_a_connection_ends_its_episode(opened: Opens) -> None:
    server = opened(captured_calls=1)
    client = server.session.connect()
    play(server, client, "a", [0])
    server.session.answer(client, observation(1), Mark("a", "task"))
    server.session.leave(client)
    again = server.session.connect()
    server.session.answer(again, observation(1), Mark("b"))
    server.session.answer(again, observation(2, words=OTHER), Mark("b"))
    run = server.close()
    assert run is not None
    columns = ["episode_id", "item_id", "group_id", "began", "ended", "client"]
    assert run.episodes[columns].to_numpy().tolist() == [
        ["a", "a", "a", "said", "said", "client-001"],
        ["a#2", "a", "task", "again", "connection", "client-001"],
        ["b", "b", "b", "said", "words", "client-002"],
        ["b#2", "b", "b", "words", "connection", "client-002"],
    ]
    assert run.episodes["policy_seed"].nunique() == 4


def test_a_faulty_observation_is_refused_by_name_and_the_episode_continues(opened: Opens) -> None:
    server = opened(captured_calls=1)
    client = server.session.connect()
    small = observation(0, side=8)
    server.session.answer(client, observation(0), Mark("a"))
    wrong: dict[str, tuple[dict[str, Any], str]] = {
        "size": (small, "(8, 8, 3); the run stores pictures of (48, 48, 3)"),
        "kind": (
            {**observation(1), "observation/image": np.zeros((48, 48, 3), np.float32)},
            "float32 (48, 48, 3)",
        ),
        "camera": ({key: value for key, value in observation(1).items() if "image" not in key}, "no picture"),
        "state": ({**observation(1), "observation/state": np.zeros(7)}, "has 7 numbers; expected 8"),
        "lost": ({key: value for key, value in observation(1).items() if "state" not in key}, "no state"),
        "finite": ({**observation(1), "observation/state": np.full(8, np.nan)}, "NaN or infinity"),
        "large": ({**observation(1), "observation/state": np.full(8, 1e300)}, "NaN or infinity"),
        "words": (observation(1, words=None), "no words"),
        "control": (observation(1, words="put\x07 it"), "control characters"),
    }
    for sent, complaint in wrong.values():
        with pytest.raises(ObservationError, match=re.escape(complaint)):
            server.session.answer(client, sent, Mark("a"))
    server.session.answer(client, observation(1), Mark("a", step=3))
    with pytest.raises(ObservationError, match="step 3 of 'a' comes after step 3"):
        server.session.answer(client, observation(1), Mark("a", step=3))
    server.session.leave(client)
    run = written(server)
    assert server.session.refused == len(wrong) + 1
    assert run.episodes[["episode_id", "inferences"]].to_numpy().tolist() == [["a", 2]]


@pytest.mark.slow
def test_the_first_observation_decides_sizes_only_if_it_was_answered(opened: Opens) -> None:
    server = opened(captured_calls=1)
    client = server.session.connect()
    with pytest.raises(UnitsError, match="other units or another robot"):
        server.session.answer(client, {**observation(0, 8), "observation/state": np.full(8, 90.0)}, Mark("a"))
    server.session.answer(client, observation(0), Mark("a"))
    run = server.close()
    assert run is not None
    assert run.settings["dataset"]["shapes"] == {"base": [48, 48, 3]}


@pytest.mark.slow
def test_a_policy_that_predicts_no_number_costs_its_own_episode(
    opened: Opens, policy: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = opened(captured_calls=1)
    client = server.session.connect()
    play(server, client, "good", [0])
    predict = type(policy).predict

    def spoilt(self: Policy, observations: Any, seeds: Any) -> Any:
        return predict(self, observations, seeds) * np.float32(np.nan)

    with monkeypatch.context() as patched:
        patched.setattr(type(policy), "predict", spoilt)
        with pytest.raises(PolicyFailedError, match="NaN or infinity"):
            server.session.answer(client, observation(1), Mark("bad"))
    play(server, client, "bad", [1])
    play(server, client, "next", [2])
    run = server.close()
    assert run is not None
    assert run.episodes["episode_id"].tolist() == ["good", "next"]
    assert "NaN or infinity" in run.failed["bad"]
    assert server.session.failed == 1


@pytest.mark.slow
def test_a_fault_of_storing_changes_no_action_and_refuses_new_episodes_until_it_is_over(
    opened: Opens, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = opened(captured_calls=1)
    client = server.session.connect()
    play(server, client, "a", [0])
    server.session.wait()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(sessions.RunWriter, "add", full)
        assert play(server, client, "b", [1])[0].size
        server.session.wait()
        with pytest.raises(sessions.StoreError, match="no further episode begins"):
            server.session.answer(client, observation(2), Mark("c"))
    play(server, client, "c", [2])
    server.session.leave(client)
    run = written(server)
    assert run.episodes["episode_id"].tolist() == ["a", "c"]
    assert "full" in run.failed["b"]


@pytest.mark.slow
def test_the_same_command_continues_a_run_and_another_one_is_refused(opened: Opens) -> None:
    server = opened(captured_calls=1)
    play(server, server.session.connect(), "a", [0])
    server.close()
    with pytest.raises(SettingsMismatchError, match="captured_calls"):
        opened(captured_calls=2)
    with pytest.raises(SettingsMismatchError, match=r"dataset\.source"):
        opened(captured_calls=1, source_name="other@1")
    server = opened(captured_calls=1, source_name=None)
    client = server.session.connect()
    with pytest.raises(ObservationError, match="the run stores pictures"):
        server.session.answer(client, observation(1, side=8), Mark("b"))
    play(server, client, "a", [1])
    run = server.close()
    assert run is not None
    assert run.episodes[["episode", "episode_id", "client"]].to_numpy().tolist() == [
        [0, "a", "client-001"], [1, "a#2", "client-002"]
    ]  # fmt: skip


GOLDEN = Path(__file__).parents[1] / "golden" / "pi0" / "checkpoint"


@pytest.mark.parametrize(
    ("choices", "complaint"),
    [
        ({"cameras": ["elbow=observation/image"]}, "the model has no such camera"),
        ({"state": ()}, "and no key of it is given"),
        ({"rule": "said", "conditions": ["none", "steer=FILE"]}, "backbone"),
    ],
)
def test_cameras_state_and_edits_are_refused_before_the_weights_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choices: dict[str, Any], complaint: str
) -> None:
    def loads(*_: object) -> None:
        raise AssertionError("the weights were read")

    monkeypatch.setattr("probe_kit.serve.server.Act.load", loads)
    file = tmp_path / "steer.json"
    file.write_text('{"edits": [{"kind": "zero", "sites": ["backbone.99.residual"]}]}', encoding="utf-8")
    if "conditions" in choices:
        choices = {**choices, "conditions": ["none", f"steer={file}"]}
    source = ServedSettings(**{"state": "observation/state", "source_name": "noise@1", **choices})
    settings = ExtractSettings("pi0", str(GOLDEN), source=source, device="cpu")
    with pytest.raises(UsageError, match=complaint):
        open_server(settings, str(tmp_path / "run"), "127.0.0.1", 0, None, {}, lambda _: None)


# -- clients without marks ---------------------------------------------------------------------------------------


def test_rows_of_a_client_without_marks_are_split_and_its_group_is_not(
    opened: Opens, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(sessions, "monotonic", lambda: clock[0])
    lines: list[Line] = []
    server = opened(lines=lines, captured_calls=1, pause=30.0)
    client = server.session.connect("arm-1")

    def send(number: float, words: str = WORDS, wait: float = 1.0) -> None:
        clock[0] += wait
        state = np.array([0.36, 0.02, 0.08, 0, 0.05, 0, 0, 0.64]) + 0.002 * number * np.arange(1, 9)
        server.session.answer(
            client, {**observation(int(number)), "observation/state": state, "prompt": words}, None
        )

    for number in (0, 1, 2, 3, 4, 5):
        send(number)
    send(0.1)  # back at the beginning
    send(1.2)
    send(2.2, OTHER)
    send(3.2, OTHER, wait=31)
    for number in (4.2, 5.2, 4.2, 3.2, 2.2, 1.2, 0.2):  # home, in steps as small as all others
        send(number, OTHER)
    server.session.leave(client)
    run = written(server)
    columns = ["episode_id", "began", "ended", "inferences", "possible_starts"]
    assert run.episodes[columns].to_numpy().tolist() == [
        ["arm-1/000001", "connection", "state", 6, 0],
        ["arm-1/000002", "state", "words", 2, 0],
        ["arm-1/000003", "words", "pause", 1, 0],
        ["arm-1/000004", "pause", "connection", 8, 1],
    ]
    assert "1 of 4 rows may hold more than one episode" in bounds_of(run.episodes)
    assert [line.possible_starts for line in lines] == [0, 0, 0, 1]
    assert set(run.episodes["group_id"]) == {"arm-1"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "rows", "groups"), [("words", 2, {WORDS, OTHER}), ("connection", 2, {"client-001"})]
)
def test_the_user_says_what_bounds_episodes(opened: Opens, rule: str, rows: int, groups: set[str]) -> None:
    server = opened(captured_calls=1, rule=rule)
    client = server.session.connect()
    for words in (WORDS, OTHER):
        server.session.answer(client, observation(0, words=words), None)
    run = server.close()
    assert run is not None
    assert len(run.episodes) == rows
    assert set(run.episodes["group_id"]) == groups


@pytest.mark.slow
def test_with_said_episodes_others_are_refused_and_nothing_is_stored(opened: Opens) -> None:
    server = opened(rule="said")
    client = server.session.connect()
    with pytest.raises(ObservationError, match="says no episode"):
        server.session.answer(client, observation(0), None)
    assert server.close() is None


@pytest.mark.slow
def test_every_third_inference_is_captured_and_small_pictures_are_not_shown_again(opened: Opens) -> None:
    server = opened(captured_calls=2, every=3, keep="small")
    client = server.session.connect()
    for number in range(8):
        server.session.answer(client, observation(number), Mark("a"))
    run = server.close()
    assert run is not None
    assert run.control_steps.tolist() == [[0, 3]]
    assert run.episodes[["frames", "inferences"]].to_numpy().tolist() == [[2, 8]]
    assert run.inputs is not None
    assert run.inputs.kinds == ("pixels", "prediction", "state")
    with pytest.raises(UsageError, match="--keep small"):
        Frames(run, ReplayFiles())
