"""`probe-kit ask` on recordings, environments and pictures: instructions are questions."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

import probe_kit as pk
from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.hooks import load_model
from probe_kit.hooks.contract.observation import Observation
from probe_kit.runs import verify_run

TEXTS = ("Put the cube on the red shape", "Put the cube on the gray shape")
FIRST = pk.Site("backbone", 2)


@pytest.fixture
def home(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with recordings, a module of an environment, and twelve pictures with labels."""
    shutil.copytree(recording, tmp_path / "rec")
    shutil.copy(Path(__file__).parents[2] / "support" / "reach_env.py", tmp_path / "reach_asked.py")
    (tmp_path / "pictures").mkdir()
    lines = ["picture,instruction,red"]
    for number in range(12):
        picture = np.random.default_rng(number).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(picture).save(tmp_path / "pictures" / f"{number}.png")
        lines.append(f"{number}.png,{TEXTS[number % 2]},{number // 2 % 2}")
    (tmp_path / "table.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


def ask(*words: str) -> Result:
    return CliRunner().invoke(app, ["ask", "--model", "vlm-tiny", "--env-workers", "0", *words])


SOURCES = {
    "recordings": (("--dataset", "rec", "--select", "every:2"), 10),
    "environment": (("--env", "reach_asked:ReachEnv", "--episodes", "0:3"), 3),
    "pictures": (("--pictures", "pictures", "--table", "table.csv"), 12),
}


@pytest.mark.parametrize(
    "source", [pytest.param(source, marks=[pytest.mark.slow] * (source == "environment")) for source in SOURCES]
)
def test_a_model_is_asked_about_every_frame_episode_or_picture(source: str, home: Path) -> None:
    options, count = SOURCES[source]
    asked = ask(*options, "--tokens", "pooled", "--out", "asked")
    assert asked.exit_code == 0, asked.output
    assert "next: probe-kit targets" in " ".join(asked.stderr.split())
    run = pk.open_run(home / "asked" / "instruction")
    assert verify_run(run.path, deep=True).ok
    assert len(run.episodes) == count
    assert set(run.episodes["question"]) <= {*run.episodes["instruction"]}
    assert set(run.episodes["outcome"]) <= {"answered", "oob"}
    assert not {"side_correct", "option_mass"} & set(run.episodes)
    assert run.column(FIRST, "mean").shape[0] == count
    if source == "recordings":
        assert run.episodes["frames"].tolist() == [1] * count
        assert run.control_steps[:, 0].tolist() == [0, 2, 4, 0, 2, 4, 0, 2, 4, 6]
    with pytest.raises(UsageError, match="no column side_correct"):
        pk.retention_table([run])


@pytest.mark.slow
def test_a_run_of_questions_is_repeated_from_its_own_settings(home: Path) -> None:
    options, _ = SOURCES["pictures"]
    assert ask(*options, "--tokens", "pooled", "--out", "asked").exit_code == 0
    first = home / "asked" / "instruction"
    again = CliRunner().invoke(app, ["ask", "--config", str(first), "--env-workers", "0", "--out", "again"])
    assert again.exit_code == 0, again.output
    assert (first / "run.json").read_bytes() == (home / "again" / "instruction" / "run.json").read_bytes()
    refused = CliRunner().invoke(app, ["extract", "--config", str(first)])
    assert refused.exit_code == 2
    assert "repeat it with `probe-kit ask --config" in " ".join(refused.stderr.split())


def test_activations_are_those_of_the_model_itself_and_numbers_of_the_table_are_probed(home: Path) -> None:
    options, _ = SOURCES["pictures"]
    assert ask(*options, "--tokens", "pooled", "--out", "asked").exit_code == 0
    run = pk.open_run(home / "asked" / "instruction")
    model = load_model("vlm-tiny")
    model.match_policies(True)  # type: ignore[attr-defined]
    picture = np.array(Image.open(home / "pictures" / "5.png"))
    observation = Observation(picture, np.zeros(8, np.float32), TEXTS[1])
    from probe_kit.hooks import Prompt, capture

    question = Prompt(observation, TEXTS[1], (f"{model.lead}Yes", f"{model.lead}No"))  # type: ignore[attr-defined]
    with capture(model, [FIRST]) as cache:
        model.read([question])  # type: ignore[attr-defined]
    np.testing.assert_allclose(run.column(FIRST, "last")[5], cache[FIRST][0, -1].numpy(), atol=1e-5)
    results = pk.train_probes(run, target="dataset.red", permutations=9, controls=("instruction",))
    assert np.isfinite(results.scores["score"]).all()


def test_yes_and_no_are_read_where_the_prompt_asks_for_them(home: Path) -> None:
    (home / "seen.txt").write_text("{instruction}. Do you see the cube? Answer yes or no.", encoding="utf-8")
    options, count = SOURCES["pictures"]
    asked = ask(*options, "--prompt", "seen.txt", "--out", "asked")
    assert asked.exit_code == 0, asked.output
    episodes = pk.open_run(home / "asked" / "seen").episodes
    assert {"logit_yes", "logit_no", "option_mass", "said"} <= set(episodes)
    assert len(episodes) == count


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--prompt", "p1"), "p1 asks for an object of a suite, and pictures have none. Use --prompt instruction"),
        (("--picture", "side-by-side"), "--picture side-by-side does not apply with --pictures"),
        (("--query", "distractor"), "--query does not apply with --pictures"),
        (("--picture-size", "64x64"), "--picture-size does not apply with --pictures"),
        (("--items", "2"), "--items does not apply with --pictures"),
    ],
)
def test_what_only_a_suite_has_is_refused_by_name(words: tuple[str, ...], message: str, home: Path) -> None:
    del home
    options, _ = SOURCES["pictures"]
    refused = ask(*options, *words, "--dry-run")
    assert refused.exit_code == 2, refused.output
    assert message in " ".join(refused.stderr.split())
