"""Conditions of episodes: files of edits, their draw, their tables, and what they leave alone."""

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import ObservationError, UsageError
from probe_kit.extract.sources.conditions import ServedCondition, read_conditions
from probe_kit.extract.sources.served import ServedSettings
from probe_kit.hooks import Policy
from probe_kit.hooks.capturing.edits import vector_hash
from probe_kit.intervene.frame_session import Frames
from probe_kit.intervene.sessions import ReplayFiles
from probe_kit.runs import open_run
from probe_kit.runs.direction_files import write_directions
from probe_kit.runs.environment_success import EnvironmentSuccess
from probe_kit.serve.marks import Mark, read_mark
from probe_kit.serve.server import Server
from probe_kit.train import load_results
from tests.support.served_sessions import WORDS, Opens, observation

SITE = "backbone.02.residual"


def edit(**changes: Any) -> dict[str, Any]:
    return {
        "kind": "add", "sites": [SITE], "roles": ["language"], "vector": "directions.npz#left", "strength": 2.0,
    } | changes  # fmt: skip


def written(folder: Path, policy: Policy, edits: Any = None, **about: str) -> Path:
    """A file of edits beside a file of directions."""
    width = policy.streams["backbone"].width
    directions = {"left": np.linspace(-1, 1, width), "both": np.eye(2, width)}
    write_directions(folder / "directions.npz", directions, {"left": about})
    file = folder / "steer.json"
    file.write_text(json.dumps({"edits": [edit()] if edits is None else edits}), encoding="utf-8")
    return file


def play(server: Server, name: str, number: int, group: str, condition: str | None = None) -> np.ndarray:
    client = server.session.connect(f"client-{number % 2}")
    mark = Mark(name, group, 0, condition)
    action = server.session.answer(client, observation(number), mark)
    server.session.end(client, Mark(end=True, facts={"success": number % 3 == 0}))
    return action


def command(*words: str) -> str:
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


@pytest.fixture
def steered(tmp_path: Path, policy: Policy) -> dict[str, Any]:
    file = written(tmp_path, policy)
    return {"captured_calls": 1, "rule": "said", "conditions": ["none", f"steer={file}"]}


@pytest.mark.slow
def test_conditions_are_balanced_in_each_group_and_none_changes_no_bit(
    opened: Opens, steered: dict[str, Any], tmp_path: Path
) -> None:
    plain, server = opened("plain", captured_calls=1, rule="said"), opened("steered", **steered)
    names = [(f"task{number // 4}/{number}", number, f"task{number // 4}") for number in range(24)]
    actions = [[play(each, *name).tobytes() for name in names] for each in (plain, server)]
    runs = [each.close() for each in (plain, server)]
    before, after = runs
    assert before is not None
    assert after is not None

    conditions = after.episodes["condition"].tolist()
    for task in range(6):
        of_task = conditions[4 * task : 4 * task + 4]
        assert [Counter(of_task[at : at + 2]) for at in (0, 2)] == [Counter(none=1, steer=1)] * 2
    assert len({tuple(conditions[4 * task : 4 * task + 4]) for task in range(6)}) > 1, "the order is drawn"

    moved = [plain_action != action for plain_action, action in zip(*actions, strict=True)]
    assert moved == [condition == "steer" for condition in conditions]
    for row, condition in enumerate(conditions):
        bytes_of = [
            (run.rows("backbone")[row].tobytes(), run.rows("expert")[row].tobytes()) for run in (before, after)
        ]
        assert (bytes_of[0] == bytes_of[1]) == (condition == "none")

    (edited,) = after.settings["dataset"]["conditions"]["steer"]
    assert edited["vector"] == vector_hash(np.linspace(-1, 1, after.streams["backbone"].width).astype(np.float32))
    logs = after.certificate["conditions"]
    assert logs["none"] == []
    (entry,) = logs["steer"]
    assert entry["site"].startswith(SITE)
    assert entry["moved"] == pytest.approx(
        2 * np.linalg.norm(np.linspace(-1, 1, after.streams["backbone"].width)), rel=1e-4
    )

    rates = EnvironmentSuccess.of(after.episodes)
    assert rates is not None
    assert [(rate.name, rate.n_episodes) for rate in rates.conditions] == [("none", 12), ("steer", 12)]
    where = str(after.location)
    trained = ("train", where, "--permutations", "20", "--controls", "none")
    line = "episodes by condition: none 12, steer 12. The probes read all of them, with the edits of steer"
    assert line in command(*trained, "--target", "env.success")
    assert line in command(*trained, "--target", "env.success"), "stored probes say it too"
    labels = tmp_path / "unedited.csv"
    unedited = after.episodes[after.episodes["condition"] == "none"]
    unedited[["episode_id", "env.success"]].rename(columns={"env.success": "solved"}).to_csv(labels, index=False)
    with pytest.warns(UserWarning, match="its groups allow no p below"):
        unedited_only = command(*trained, "--labels", str(labels), "--target", "solved")
    assert "episodes by condition" not in unedited_only
    assert load_results(after, target="env.success").conditions == {"none": 12, "steer": 12}
    table = command("retention", where, "--target", "env.success")
    assert "success rate by condition, of 24 episodes: none" in table
    assert "condition steer against none: p " in table

    frames = Frames(after, ReplayFiles())
    replayed = {frame.episode for frame in frames.index}
    assert replayed == {
        name for (name, _, _), condition in zip(names, conditions, strict=True) if condition == "none"
    }


def test_a_rate_is_compared_within_groups() -> None:
    """The easy group has more episodes of one condition: over all episodes it would seem to be better."""
    rows = [("easy", "none", True)] * 2 + [("easy", "steer", True)] * 6
    rows += [("hard", "none", False)] * 6 + [("hard", "steer", False)] * 2
    episodes = pd.DataFrame(rows, columns=["group_id", "condition", "success_at_end"])
    rates = EnvironmentSuccess.of(episodes)
    assert rates is not None
    none, steer = rates.conditions
    assert (none.sr, steer.sr) == (0.25, 0.75)
    assert (none.difference, steer.difference, steer.n_groups) == (None, 0.0, 2)
    assert "steer 75% of 8 (+0 points within 2 groups)" in rates.sentence


def test_a_mark_says_the_condition_and_the_same_command_goes_on_in_the_block(
    opened: Opens, steered: dict[str, Any]
) -> None:
    server = opened("run", **steered)
    play(server, "a", 0, "task", "steer")
    client = server.session.connect("c")
    with pytest.raises(ObservationError, match="the condition is 'push'; the server has none, steer"):
        server.session.answer(client, observation(1), Mark("b", "task", 0, "push"))
    server.session.answer(client, observation(1), Mark("b", "task", 0))
    with pytest.raises(ObservationError, match="it began with another one"):
        server.session.answer(client, observation(1), Mark("b", "task", 1, "steer"))
    other_words = observation(2, words="put the cube on the blue shape")
    server.session.answer(client, other_words, Mark("b", "task", 2))
    run = server.close()
    assert run is not None
    assert run.certificate["conditions"]["none"] == []
    assert [entry["site"] for entry in run.certificate["conditions"]["steer"]] == [SITE]
    assert "success rate by condition, of 1 episode: steer 100% of 1" in command("run", "show", str(run.location))
    assert run.episodes[["episode_id", "condition"]].to_numpy().tolist() == [
        ["a", "steer"], ["b", "none"], ["b#2", "none"]
    ]  # fmt: skip

    server = opened("run", **steered)
    for number in range(4):
        play(server, f"c{number}", number, "task")
    run = server.close()
    assert run is not None
    assert Counter(run.episodes["condition"][3:]) == Counter(none=2, steer=2)
    without = opened("other", captured_calls=1)
    with pytest.raises(ObservationError, match="start it with --condition"):
        without.session.answer(without.session.connect(), observation(0), Mark("a", condition="steer"))


@pytest.mark.parametrize(
    ("edits", "complaint"),
    [
        ([edit(sites=["backbone.99.residual"])], "backbone has no layer 99|backbone.99"),
        ([edit(roles=["gripper"])], "no token of backbone plays the role 'gripper'"),
        ([edit(sites=["expert.01.residual"])], "has 32 numbers|expert"),
        ([edit(vector="directions.npz#right")], "has the directions left, both"),
        ([edit(vector="0" * 64)], "expected FILE#NAME"),
        ([edit(kind="replace")], "replace needs the tokens of another inference"),
        ([edit(kind="remove", vector="directions.npz#both")], "remove takes one direction"),
        ([edit(kind="push")], "edit kind 'push' does not exist"),
        ([edit(strength=float("nan"))], "strength"),
        ([edit(layer=2)], "layer"),
        ([edit(sites=SITE)], "lists of texts"),
        ([3], "it is a int"),
        ([], "holds no list of edits"),
    ],
    ids=str,
)
def test_a_file_of_edits_that_the_model_cannot_have_is_refused_before_anything_is_served(
    opened: Opens, tmp_path: Path, policy: Policy, edits: list[Any], complaint: str
) -> None:
    file = written(tmp_path, policy, edits)
    with pytest.raises(UsageError, match=complaint):
        opened(rule="said", conditions=[f"steer={file}"])


def test_directions_of_other_weights_or_another_site_are_refused(
    opened: Opens, tmp_path: Path, policy: Policy
) -> None:
    for about, complaint in (
        ({"weights": "f" * 64}, "found in the weights ffffffffffff"),
        ({"site": "backbone.01"}, "is a direction of backbone.01"),
    ):
        file = written(tmp_path, policy, None, **about)
        with pytest.raises(UsageError, match=complaint):
            opened(rule="said", conditions=[f"steer={file}"])


@pytest.mark.parametrize(
    ("texts", "complaint"),
    [
        (["steer"], "a condition has a file of edits"),
        (["none=edits.json"], "none is the condition without edits"),
        (["none", "none"], "given twice"),
        (["steer=absent.json"], "there is no such file"),
        (["=x"], "expected none, or NAME=FILE"),
    ],
)
def test_a_condition_has_a_name_and_a_file(texts: list[str], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        read_conditions(texts)


def test_guessed_episodes_get_no_condition() -> None:
    with pytest.raises(UsageError, match=re.escape("Add --episodes said")):
        ServedSettings(conditions=["none"])
    stored = ServedSettings(conditions=["none"], rule="said").model_dump(mode="json")
    assert stored["conditions"] == [{"name": "none", "edits": []}]
    assert ServedSettings(**stored).conditions == (ServedCondition("none"),)
    assert read_mark({"id": "a", "condition": "steer"}).condition == "steer"
    with pytest.raises(ObservationError, match="the condition is 5"):
        read_mark({"id": "a", "condition": 5.5})


def test_a_run_of_edited_episodes_alone_cannot_be_shown_again(
    opened: Opens, tmp_path: Path, policy: Policy
) -> None:
    server = opened(captured_calls=1, rule="said", conditions=[f"steer={written(tmp_path, policy)}"])
    play(server, "a", 0, "g")
    run = server.close()
    assert run is not None
    with pytest.raises(UsageError, match="all its episodes were edited"):
        Frames(open_run(run.location), ReplayFiles())
    assert WORDS in run.episodes["instruction"].tolist()
