"""Probes of another run read the episodes of a run that has none, such as one that is being extracted."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UsageError
from probe_kit.runs import Run, open_run
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from probe_kit.train import load_results
from probe_kit.view.catalogue import Catalogue
from tests.support.little_run import certify, episode, little_plan, little_settings, little_writer
from tests.view.payload_reader import log_odds, read_payload

WRITTEN = (0, 1, 5)


@pytest.fixture(scope="module")
def unfinished(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Three episodes with other activations than those of the small run."""
    where = tmp_path_factory.mktemp("unfinished") / "now"
    plan = little_plan(small_suite)
    writer = little_writer(locate(where), plan, seed=2)
    for number in WRITTEN:
        writer.write(episode(plan, number, seed=2))
    return open_run(where, allow_partial=True)


@pytest.fixture(scope="module")
def catalogue(unfinished: Run, little: Run) -> Catalogue:
    return Catalogue([unfinished], little)


def read(catalogue: Catalogue, name: str):
    return read_payload(catalogue.script(name))[1]


def test_log_odds_are_of_the_runs_own_activations_and_held_out_by_item(
    catalogue: Catalogue, unfinished: Run, little: Run
) -> None:
    results = load_results(little)
    curve = results.curves["color", "mean"]
    fold_of = dict(zip(curve.items.tolist(), curve.fold_of.tolist(), strict=True))
    for position, row in enumerate(unfinished.episodes.to_dict("records")):
        side = 1 if row["side_correct"] == "left" else -1
        expected = []
        for site in curve.sites:
            probe, fold = results.direction("color", "mean", site), fold_of[row["item_id"]]
            features = unfinished.rows(site.stream)[position][0][unfinished.stored(site.stream).at(site)][0]
            expected.append(side * (probe.weights[fold].astype(np.float64) @ features + probe.intercepts[fold]))
        payload = read(catalogue, f"now/e/{row['episode']:05d}")
        assert payload["held_out"]
        np.testing.assert_allclose(log_odds(payload["log_odds"]), expected, atol=1 / 256)
        best = read(catalogue, "now/run")["categories"][0]["best"]["backbone"]["site"]
        shown = read(catalogue, "now/episodes")["log_odds"]["backbone"]
        np.testing.assert_allclose(log_odds(shown)[position], expected[best], atol=1 / 256)


def test_the_page_says_whose_probes_they_are_and_shows_their_scores(catalogue: Catalogue, little: Run) -> None:
    run = read(catalogue, "now/run")
    assert run["probes_of"] == little.label
    assert [column["key"] for column in run["table"]["columns"]] == ["success.sr"], "no rate of lent probes"
    own = read(Catalogue([little]), "run/map/color")
    lent = read(catalogue, "now/map/color")
    assert lent["cells"] == own["cells"]
    assert lent["rows"] == [0, 1, 2]
    assert read(Catalogue([little], little), "run/run")["probes_of"] is None


def test_probes_of_another_model_are_refused(small_suite: Suite, little: Run, tmp_path: Path) -> None:
    plan = little_plan(small_suite, episodes=2)
    writer = RunWriter(locate(tmp_path / "run"), plan, {**little_settings(), "weights_sha256": "1" * 64})
    certify(writer)
    writer.write(episode(plan, 0))
    other = open_run(tmp_path / "run", allow_partial=True)
    with pytest.raises(UsageError, match="other weights, 111111111111 instead of 000000000000"):
        Catalogue([other], little)
    with pytest.raises(UsageError, match="has no probes"):
        Catalogue([little], other)


def test_a_study_without_stored_runs_says_how_to_play_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    answer = CliRunner().invoke(app, ["view", "embedded", "--export", "page"])
    assert answer.exit_code != 0
    assert "probe-kit study run embedded" in " ".join(answer.stderr.split())
