"""The control `untrained` of a label: the same frames through another network."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.runs import Run, open_run
from probe_kit.suite import Suite
from probe_kit.train import ProbeResults, Target, load_results, train_probes
from tests.support.labelled_run import write_labelled_run
from tests.support.recorded_run import write_recorded_run

pytestmark = pytest.mark.slow  # `tests/acceptance` holds what a user sees of it

TARGET = "dataset.state.x"


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return write_recorded_run(tmp_path / "run")


def probed(run: Run, **further: Any) -> ProbeResults:
    return train_probes(run, target=Target.of_run(run, TARGET), permutations=59, controls=(), **further)


def test_a_site_that_an_untrained_network_has_too_is_no_signal(run: Run, tmp_path: Path) -> None:
    blind = write_recorded_run(tmp_path / "blind", weights="1" * 64, planted=False)
    seeing = write_recorded_run(tmp_path / "seeing", weights="2" * 64)
    against_blind = probed(run, untrained=blind).scores.set_index("layer")
    assert against_blind.loc[1, "exceeds_untrained"]
    assert against_blind.loc[1, "signal"]
    assert not against_blind.loc[0, "exceeds_untrained"]
    own = probed(seeing).scores
    results = probed(run, untrained=seeing)
    against_seeing = results.scores.set_index("layer")
    assert not against_seeing.loc[1, "exceeds_untrained"]
    assert not against_seeing.loc[1, "signal"]
    assert against_seeing.loc[1, "best_control"] == own["score"].max(), "the best site of the stream"
    assert [score.name for score in results.controls.scores] == ["untrained"], "the former one was replaced"
    assert results.key == load_results(run, target=TARGET).key


def test_the_comparison_is_stored_and_not_made_again(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = write_recorded_run(tmp_path / "blind", weights="1" * 64, planted=False)
    first = probed(run, untrained=blind)
    monkeypatch.setattr("probe_kit.train.probe_sweep.probe_columns", None)
    for again in (probed(run, untrained=blind), probed(run), load_results(run, target=TARGET)):
        assert again.controls == first.controls
    monkeypatch.undo()
    further = train_probes(run, target=Target.of_run(run, TARGET), permutations=59, controls=("state",))
    assert set(further.controls.names) == {"untrained", "state"}
    answer = CliRunner().invoke(
        app,
        ["train", str(run.path), "--target", TARGET, "--permutations", "59", "--controls", "none", "--untrained",
         str(blind.path)],
        env={"COLUMNS": "200"},
    )  # fmt: skip
    assert "control untrained" in answer.stdout


def test_other_frames_are_refused(run: Run, tmp_path: Path, labelled_run: Path) -> None:
    with pytest.raises(UsageError, match="cannot be its own untrained control"):
        probed(run, untrained=open_run(run.path))
    other = write_recorded_run(tmp_path / "other", weights="1" * 64, pixels=False)
    with pytest.raises(UsageError, match=r"another dataset than .*by the same command"):
        probed(run, untrained=other)
    with pytest.raises(UsageError, match="another dataset"):
        probed(run, untrained=open_run(labelled_run))
    fewer = write_recorded_run(tmp_path / "fewer", episodes=8, weights="1" * 64)
    with pytest.raises(UsageError, match=r"has no episode .*expected all"):
        probed(run, untrained=fewer)


def test_later_inferences_of_networks_that_acted_are_refused(small_suite: Suite, tmp_path: Path) -> None:
    suite = small_suite.select([small_suite.categories[0]])
    run = write_labelled_run(tmp_path / "run", suite)
    other = write_labelled_run(tmp_path / "other", suite, weights="1" * 64)
    labels = Target.of_run(run, "sim.tool_y")
    with pytest.raises(UsageError, match="acted otherwise, so it saw other frames"):
        train_probes(run, target=labels, permutations=0, controls=(), untrained=other)
    first = train_probes(run, target=labels, permutations=0, controls=(), untrained=other, window=1)
    assert first.controls.names == ("untrained",)
