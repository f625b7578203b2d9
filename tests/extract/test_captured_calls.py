"""Several captured inferences per episode: an axis of its own, also where episodes end early."""

from pathlib import Path

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.extract import ExtractSettings, Run, extract_run, open_run, prepare, seal, verify_run
from probe_kit.extract.plan import make_plan
from probe_kit.extract.rollout.episode_buffers import EpisodeBuffers
from probe_kit.extract.rollout.episode_loop import Rollout
from probe_kit.extract.run_layout import StoredStream
from probe_kit.extract.store.locations.locate import locate
from probe_kit.extract.store.writer import RunWriter
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.estimators.by_call import CallCurves
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.by_call import load_calls

STREAM = StoredStream("backbone", 2, 8, None, 6, ("mean", "last", "mean:language"))
CALLS = 3
SITE = Site("backbone", 1)


def inferences_of(number: int) -> int:
    """Every fifth episode ends after its first inference, every fourth other one after its second."""
    return 1 if number % 5 == 4 else 2 if number % 4 == 3 else CALLS


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """48 episodes; features of inference c are noise around 10 c, and name the answer from the second on."""
    settings = {
        "captured_calls": CALLS, "tokens": "all", "codec": "zstd", "model": "synthetic", "random_weights": False,
        "weights_sha256": None, "suite": {"identity": small_suite.identity},
    }  # fmt: skip
    plan = make_plan(small_suite, [STREAM], 0, CALLS, True)
    writer = RunWriter(locate(tmp_path_factory.mktemp("calls") / "run"), plan, settings)
    for planned in plan.episodes:
        draw = np.random.default_rng(planned.index)
        buffers = EpisodeBuffers([STREAM], CALLS, True, pinned=False)
        for call in range(inferences_of(planned.index)):
            values = draw.normal(size=(2, 3, 8)) + 10 * call
            values[..., 0] += 3 * (call > 0) * (planned.episode.side_correct == "left")
            buffers.pooled["backbone"][call] = values
            buffers.tokens["backbone"][call] = 0x3F80 + call
            buffers.roles.append({"backbone": [("language", 0, 4), ("padding", 4, 6)]})
        outcome = {"outcome": "oob", "side_placed": "none", "cube_x": 0.0, "cube_y": 0.0}
        writer.write(Rollout(planned, outcome, buffers, []).record)
    return open_run(writer.location)


@pytest.mark.filterwarnings("ignore:.*is not sealed")
@pytest.mark.parametrize("sealed", [False, True])
def test_every_inference_is_read_apart_and_missing_ones_are_nan(run: Run, sealed: bool) -> None:
    if sealed:
        seal(run.location)
    run = open_run(run.location)
    assert run.sealed == sealed
    for call in range(CALLS):
        column, reached = run.column(SITE, "mean", call), run.reached(call)
        assert reached.tolist() == [inferences_of(number) > call for number in range(48)]
        assert np.isnan(column[~reached]).all()
        np.testing.assert_allclose(column[reached][:, 1:].mean(), 10 * call, atol=0.2)
    assert verify_run(run.location, deep=True).ok


def test_the_axis_of_inferences_is_called_so_everywhere(run: Run) -> None:
    seal(run.location)
    run = open_run(run.location)
    assert run.rows("backbone").array.metadata.dimension_names == ("episode", "call", "layer", "view", "feature")
    assert run.rows("backbone", "tokens").array.metadata.dimension_names[:2] == ("episode", "call")
    assert run.xarray()["backbone_pooled"].dims[:2] == ("episode", "call")


def test_tokens_of_a_later_inference_are_those_of_the_episodes_that_had_one(run: Run) -> None:
    values, mask = run.tokens(SITE, "language", call=2)
    assert mask.any(axis=1).tolist() == run.reached(2).tolist()
    assert (values[~run.reached(2)] == 0).all()
    assert (values[run.reached(2)][:, :4] > 1).all()


@pytest.mark.parametrize("call", [-1, CALLS])
def test_an_inference_that_was_not_captured_is_refused(run: Run, call: int) -> None:
    with pytest.raises(UnknownSiteError, match="3 captured inferences"):
        run.column(SITE, "mean", call)
    with pytest.raises(UsageError, match="3 captured inferences") if call > 0 else pytest.raises(UsageError):
        train_probes(run, permutations=0, call=call)


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_probes_are_of_the_inference_that_was_asked_for(run: Run) -> None:
    by_call = [train_probes(run, ("all",), permutations=5, call=call) for call in range(CALLS)]
    best = [results.scores["accuracy"].max() for results in by_call]
    assert best[0] < 0.75
    assert min(best[1:]) > 0.85
    assert [int(results.scores["n"].iloc[0]) for results in by_call] == [
        run.reached(c).sum() for c in range(CALLS)
    ]
    assert len({results.key for results in by_call}) == CALLS


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_tables_are_of_the_first_inference_unless_a_key_says_otherwise(run: Run) -> None:
    first = train_probes(run, permutations=5)
    later = train_probes(run, permutations=5, call=1)
    assert load_results(run).key == first.key
    assert retention_table([run]).results[str(run.location)].key == first.key
    table = retention_table([run], keys=[later.key])
    assert any("captured inference 1" in note for note in table.notes)
    assert not any("other episodes" in note for note in table.notes)


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_calls_that_were_fitted_alike_make_a_curve(run: Run) -> None:
    first, *_ = [train_probes(run, ("all",), permutations=5, call=call) for call in range(CALLS)]
    train_probes(run, ("all",), permutations=4, call=1)
    calls = load_calls(run, first)
    assert list(calls) == list(range(CALLS))
    assert {one.settings.permutations for one in calls.values()} == {5}
    line = CallCurves.of(calls, "all", "mean").line("backbone")
    assert line.episodes.tolist() == [int(run.reached(call).sum()) for call in range(CALLS)]
    assert line.accuracy[1] > 0.85 > line.accuracy[0]
    exhibits = collect_figures([run], retention_table([run], keys=[first.key]))
    assert f"{run.location.name}-calls" in [exhibit.name for exhibit in exhibits]


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_token_views_of_a_later_inference_are_probed_too(run: Run) -> None:
    results = train_probes(run, ("all",), ("tokens:language",), permutations=0, token_permutations=0, call=2)
    assert int(results.scores["n"].iloc[0]) == run.reached(2).sum()


def test_a_real_policy_is_captured_at_every_inference(small_suite: Suite, tmp_path: Path) -> None:
    settings = ExtractSettings(
        "pi0-tiny", suite=small_suite.folder, items=2, scene=SceneSpec(max_steps=4), execute=2, captured_calls=2,
        env_workers=0,
    )  # fmt: skip
    run = extract_run(settings, tmp_path / "run")
    site = run.sites("expert")[-1]
    assert run.reached(1).all()
    assert np.isfinite(run.column(site, "mean", 1)).all()
    assert (run.column(site, "mean", 0) != run.column(site, "mean", 1)).any()


def test_more_inferences_than_an_episode_can_have_are_refused(small_suite: Suite) -> None:
    settings = ExtractSettings(
        "pi0-tiny", suite=small_suite.folder, scene=SceneSpec(max_steps=4), execute=2, captured_calls=3
    )
    with pytest.raises(UsageError, match="have at most 2"):
        prepare(settings)
