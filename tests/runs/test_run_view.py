"""A view of a run shows other episodes or outcomes; activations, settings and location are the run's."""

import numpy as np

from probe_kit.runs.run import Run
from probe_kit.runs.run_view import view_run


def test_a_view_shows_its_episodes_and_leaves_the_run_as_it_was(recorded_run: Run) -> None:
    every = recorded_run.episodes
    left = every[every["side_correct"] == "left"]
    view = view_run(recorded_run, left, score="logits")
    assert isinstance(view, Run)
    assert view.episodes["episode_id"].tolist() == left["episode_id"].tolist()
    assert (view.score, recorded_run.score) == ("logits", "text")
    assert recorded_run.episodes is every
    assert (view.location, view.stamp, view.label) == (
        recorded_run.location,
        recorded_run.stamp,
        recorded_run.label,
    )
    site = recorded_run.sites("backbone")[0]
    np.testing.assert_array_equal(view.column(site)[left.index], recorded_run.column(site)[left.index])


def test_trajectories_and_judgements_of_a_view_are_of_every_episode_of_the_run(recorded_run: Run) -> None:
    every = recorded_run.episodes
    view = view_run(recorded_run, every.iloc[3:])
    last = str(every["episode_id"].iloc[-1])
    np.testing.assert_array_equal(view.trajectory(last).tool, recorded_run.trajectory(last).tool)
    assert view.judged("disc").equals(recorded_run.judged("disc"))
    assert view.behaviour.equals(recorded_run.behaviour)
    assert view.under("box").episodes.equals(recorded_run.under("box").episodes.loc[view.episodes.index])


def test_a_view_of_a_view_knows_the_run_that_both_are_of(recorded_run: Run) -> None:
    first = view_run(recorded_run, recorded_run.episodes[:4])
    second = view_run(first, first.episodes[:2])
    assert recorded_run.viewed is None
    assert first.viewed is recorded_run
    assert second.viewed is recorded_run


def test_outcomes_by_another_rule_are_a_view(recorded_run: Run) -> None:
    judged = recorded_run.under("box")
    assert judged.viewed is recorded_run
    assert (judged.rule, recorded_run.rule) == ("box", "disc")
    assert judged.episodes.index.tolist() == recorded_run.episodes.index.tolist()
