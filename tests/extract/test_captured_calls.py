"""Several captured inferences per episode: an axis of its own, also where episodes end early."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors import safe_open
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import (
    ActivationsLeftOutError,
    TooFewGroupsError,
    UnbalancedEpisodesError,
    UnknownSiteError,
    UsageError,
)
from probe_kit.extract import ExtractSettings, extract_run, prepare
from probe_kit.extract.rollout.capturing import EpisodeBuffers
from probe_kit.extract.states import count_calls
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.retention.displays import collect_figures
from probe_kit.retention.displays.call_curves import CallCurves
from probe_kit.runs import Run, copy_run, export_run, open_run, seal, verify_run
from probe_kit.runs.layout import LaterViews, StoredStream
from probe_kit.runs.store import locate
from probe_kit.runs.writer import RunWriter
from probe_kit.suite import Suite
from probe_kit.train import load_results, train_probes
from probe_kit.train.results.store import load_results_by_call
from tests.support.little_run import suite_record
from tests.support.plans import make_plan

STREAM = StoredStream("backbone", 2, 8, None, 6, ("mean", "last", "mean:language"))
CALLS = 3
SITE = Site("backbone", 1)


def inferences_of(number: int) -> int:
    """Every fifth episode ends after its first inference, every fourth other one after its second."""
    return 1 if number % 5 == 4 else 2 if number % 4 == 3 else CALLS


pytestmark = pytest.mark.filterwarnings("ignore:.*is not sealed")


def write_run(where: Path, suite: Suite, later_views: LaterViews = "all") -> Run:
    """48 episodes; features of inference c are noise around 10 c, and name the answer from the second on."""
    with_tokens = later_views == "all"
    settings = {
        "captured_calls": CALLS, "tokens": "all" if with_tokens else "pooled", "codec": "zstd",
        "model": "synthetic", "random_weights": False, "weights_sha256": None,
        "suite": suite_record(suite), **({} if with_tokens else {"later_views": later_views}),
    }  # fmt: skip
    plan = make_plan(suite, [STREAM], 0, CALLS, with_tokens, later_views=later_views)
    writer = RunWriter(locate(where), plan, settings)
    for planned in plan.episodes:
        draw = np.random.default_rng(planned.index)
        buffers = EpisodeBuffers([STREAM], CALLS, with_tokens, False, later_views)
        for call in range(inferences_of(planned.index)):
            values = draw.normal(size=(2, 3, 8)) + 10 * call
            values[..., 0] += 3 * (call > 0) * (planned.content.side_correct == "left")
            buffers.roles.append({"backbone": [("language", 0, 4), ("padding", 4, 6)]})
            buffers.keep_pooled("backbone", torch.from_numpy(values.astype(np.float32)))
            if with_tokens:
                buffers.tokens["backbone"][call] = 0x3F80 + call
        outcome = {"outcome": "oob", "side_placed": "none", "cube_x": 0.0, "cube_y": 0.0}
        steps = range(len(buffers.roles))
        writer.write(buffers.record(planned, outcome, control_steps=steps))
    return open_run(writer.location)


@pytest.fixture(scope="module")
def run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return write_run(tmp_path_factory.mktemp("calls") / "run", small_suite)


@pytest.fixture(scope="module")
def mean_run(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The same numbers, of which later inferences keep the mean alone."""
    return write_run(tmp_path_factory.mktemp("mean") / "run", small_suite, "mean")


def in_bfloat16(values: np.ndarray) -> np.ndarray:
    return torch.from_numpy(values).to(torch.bfloat16).to(torch.float32).numpy()


@pytest.mark.parametrize("sealed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_later_inferences_that_keep_the_mean_have_it_in_bfloat16(run: Run, mean_run: Run, sealed: bool) -> None:
    if sealed:
        seal(mean_run.location)
    mean_run = open_run(mean_run.location)
    assert mean_run.sealed == sealed
    for view in STREAM.views:
        np.testing.assert_array_equal(mean_run.column(SITE, view), run.column(SITE, view))
    for call in range(1, CALLS):
        np.testing.assert_array_equal(
            mean_run.column(SITE, "mean", call), in_bfloat16(run.column(SITE, "mean", call))
        )
        assert mean_run.views("backbone", call) == ("mean",)
        with pytest.raises(UnknownSiteError, match=f"'last' of backbone at inference {call}.*stored: mean"):
            mean_run.column(SITE, "last", call)
    assert verify_run(mean_run.location, deep=True).ok
    assert mean_run.xarray()["backbone_pooled"].sizes["call"] == 1


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_probes_of_later_inferences_read_the_mean_and_no_other_view(mean_run: Run) -> None:
    assert train_probes(mean_run, ("color",), permutations=0, call=1, controls=()).scores["accuracy"].max() > 0.85
    with pytest.raises((UsageError, UnknownSiteError), match="last"):
        train_probes(mean_run, ("color",), ("last",), permutations=0, call=1, controls=())


@pytest.mark.slow
def test_an_export_and_a_copy_know_of_later_inferences_that_keep_the_mean(mean_run: Run, tmp_path: Path) -> None:
    with safe_open(export_run(mean_run.location, "safetensors", tmp_path / "one"), framework="numpy") as file:
        assert file.get_slice("backbone.pooled").get_shape() == [48, 1, 2, 3, 8]
        assert file.get_slice("backbone.later").get_shape() == [48, 2, 2, 8]
    table = pd.read_parquet(export_run(mean_run.location, "parquet", tmp_path / "two"))
    rows = table[(table["inference"] == 2) & (table["site"] == str(SITE))]
    assert set(rows["view"]) == {"mean"}
    expected = mean_run.column(SITE, "mean", 2)[mean_run.reached(2)]
    np.testing.assert_array_equal(np.stack(rows["vector"]), expected)
    copy = copy_run(mean_run.location, tmp_path / "copy")
    with pytest.raises(ActivationsLeftOutError):
        copy.column(SITE, "mean", 2)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"later_views": "mean"}, "the first alone is captured"),
        ({"later_views": "mean", "captured_calls": 3, "tokens": "all"}, "contradict"),
        ({"later_views": "last", "captured_calls": 3}, "all, mean"),
    ],
)
def test_a_view_of_later_inferences_that_cannot_be_kept_is_refused(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        ExtractSettings("pi0-tiny", **options)


def test_all_inferences_are_as_many_as_an_episode_can_have() -> None:
    settings = ExtractSettings("pi0-tiny", scene=SceneSpec(max_steps=5), captured_calls="all")
    assert [count_calls(settings, execute).calls for execute in (1, 2, 5, 8)] == [5, 3, 1, 1]
    assert count_calls(settings, 2).settings == settings.changed(captured_calls=3)
    assert count_calls(settings.changed(captured_calls=4), 2).calls == 4


def test_bytes_of_a_run_count_what_later_inferences_keep() -> None:
    cells = STREAM.layers * STREAM.width
    assert STREAM.raw_bytes(False, CALLS) == CALLS * cells * 3 * 4
    assert STREAM.raw_bytes(False, CALLS, "mean") == cells * 3 * 4 + (CALLS - 1) * cells * 2


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_tables_are_of_the_first_inference_unless_a_key_says_otherwise(run: Run) -> None:
    first = train_probes(run, permutations=5)
    later = train_probes(run, permutations=5, call=1)
    assert load_results(run).key == first.key
    assert retention_table([run]).results_of(run.location).key == first.key
    table = retention_table([run], keys=[later.key])
    assert any("captured inference 1" in note for note in table.notes)
    assert not any("other episodes" in note for note in table.notes)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_calls_that_were_fitted_alike_make_a_curve(run: Run) -> None:
    first, *_ = [train_probes(run, ("all",), permutations=5, call=call) for call in range(CALLS)]
    train_probes(run, ("all",), permutations=4, call=1)
    calls = load_results_by_call(run, first)
    assert list(calls) == list(range(CALLS))
    assert {curve.settings.permutations for curve in calls.values()} == {5}
    line = CallCurves.of(calls, "all", "mean").line("backbone")
    assert line.episodes.tolist() == [int(run.reached(call).sum()) for call in range(CALLS)]
    assert line.accuracy[1] > 0.85 > line.accuracy[0]
    exhibits = collect_figures([run], retention_table([run], keys=[first.key]))
    assert f"{run.location.name}-calls" in [exhibit.name for exhibit in exhibits]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_token_views_of_a_later_inference_are_probed_too(run: Run) -> None:
    results = train_probes(run, ("all",), ("tokens:language",), permutations=0, token_permutations=0, call=2)
    assert int(results.scores["n"].iloc[0]) == run.reached(2).sum()


@pytest.mark.slow
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
    every = extract_run(settings.changed(captured_calls="all"), tmp_path / "every")
    assert every.settings_sha256 == run.settings_sha256
    np.testing.assert_array_equal(every.column(site, "mean", 1), run.column(site, "mean", 1))
    fewer = extract_run(settings.changed(captured_calls="all", later_views="mean"), tmp_path / "fewer")
    np.testing.assert_array_equal(fewer.column(site, "mean", 1), in_bfloat16(run.column(site, "mean", 1)))


@pytest.mark.slow
def test_more_inferences_than_an_episode_can_have_are_refused(small_suite: Suite) -> None:
    settings = ExtractSettings(
        "pi0-tiny", suite=small_suite.folder, scene=SceneSpec(max_steps=4), execute=2, captured_calls=3
    )
    with pytest.raises(UsageError, match="have at most 2"):
        prepare(settings)


@pytest.fixture(scope="module")
def early(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Captured at six inferences at most: two categories, of which few reach the fourth and none the sixth.

    All episodes have three. Of Color, four of one layout have a fourth; of Shape, all; one episode has a fifth.
    """
    settings = {
        "captured_calls": 6, "tokens": "pooled", "codec": "zstd", "model": "synthetic", "random_weights": False,
        "weights_sha256": None, "suite": suite_record(small_suite),
    }  # fmt: skip
    plan = make_plan(small_suite, [STREAM], 0, 6, False)
    writer = RunWriter(locate(tmp_path_factory.mktemp("early") / "run"), plan, settings)
    left_episodes: list[int] = [e.index for e in plan.episodes if e.content.item.category == "color"
                       and e.content.side_correct == "left"][:4]  # fmt: skip
    for planned in plan.episodes:
        fourth = planned.index in left_episodes or planned.content.item.category == "shape"
        draw = np.random.default_rng(planned.index)
        buffers = EpisodeBuffers([STREAM], 6, False, pinned=False)
        for call in range(3 + fourth + (planned.index == left_episodes[0])):
            buffers.pooled["backbone"][call] = draw.normal(size=(2, 3, 8))
            buffers.roles.append({"backbone": [("language", 0, 4), ("padding", 4, 6)]})
        outcome = {"outcome": "oob", "side_placed": "none", "cube_x": 0.0, "cube_y": 0.0}
        steps = range(len(buffers.roles))
        writer.write(buffers.record(planned, outcome, control_steps=steps))
    seal(writer.location)
    return open_run(writer.location)


def fit(run: Run, *options: str) -> tuple[int, str]:
    arguments = ["train", str(run.location), "--permutations", "0", "--controls", "none", *options]
    answer = CliRunner().invoke(app, arguments)
    return answer.exit_code, " ".join(answer.stderr.split())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
def test_all_inferences_are_those_that_enough_episodes_reached_and_the_others_are_named(early: Run) -> None:
    code, message = fit(early, "--call", "all")
    assert code == 0, message
    assert "left out: call 3: category 'color': classes are not balanced, chance is 1.000" in message
    assert "left out: call 4: category 'color': " in message
    assert "left out: call 5: category 'color': no episode got as far as captured inference 5" in message
    assert message.count("left out") == 3
    assert list(load_results_by_call(early, load_results(early))) == [0, 1, 2]
    assert (
        fit(early, "--call", "all", "--categories", "shape")[1].count("left out") == 2
    )  # of Shape all had the fourth


@pytest.mark.filterwarnings("ignore:.*classes are not balanced")
@pytest.mark.parametrize("call", [3, 4, 5])
@pytest.mark.parametrize("target", ["side.correct", "side.shuffled"])
def test_of_an_inference_that_few_episodes_reached_nothing_is_said_to_be_missing(
    early: Run, call: int, target: str
) -> None:
    code, message = fit(early, "--call", str(call), "--target", target)
    assert code in (1, 3)
    number = {3: "only 4 episodes", 4: "only 1 episode", 5: "no episode"}[call]
    assert f"{number} got as far as captured inference {call}, counted from 0" in message
    assert "xtract" not in message
    assert "missing" not in message
    assert "defect" not in message


@pytest.mark.parametrize("call", [3, 5])
def test_a_category_that_ended_before_an_inference_is_still_one_of_the_run(early: Run, call: int) -> None:
    for categories in (None, ["color"], ["shape", "color"]):
        with pytest.raises((TooFewGroupsError, UnbalancedEpisodesError), match=r"'color'|'shape'"):
            train_probes(early, categories, permutations=0, call=call, controls=())


def test_a_twin_whose_episodes_ended_at_other_times_is_not_said_to_be_of_another_suite(
    early: Run, run: Run
) -> None:
    with pytest.raises(UsageError, match="captured inference 1: leave --call or --untrained out"):
        train_probes(run, ["color"], permutations=0, call=1, controls=(), untrained=early, incomplete="drop")
