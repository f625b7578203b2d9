"""The instrument as a whole: what was planted is found where it was planted, and nothing else is found."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from probe_kit.hooks.contract.sites import Site
from probe_kit.retention import retention_table
from probe_kit.runs import Run, open_run
from probe_kit.train import train_probes
from tests.support.rehashing import rehash

PLANTED = Site("backbone", 2)


@pytest.fixture
def planted_run(trainable_run: Run, tmp_path: Path) -> Run:
    """The recorded run with the answer added along one direction of one layer's mean."""
    copy = Path(shutil.copytree(trainable_run.path, tmp_path / "planted"))
    pooled = zarr.open_array(copy / "data.zarr/backbone/pooled", mode="r+")
    answer = np.where(trainable_run.episodes["side_correct"] == "left", 1.0, -1.0)
    direction = np.random.default_rng(0).normal(size=pooled.shape[-1])
    view = trainable_run.views("backbone").index("mean")
    values = pooled[: answer.size]  # the array has room for a million episodes
    values[:, 0, PLANTED.layer, view] += answer[:, None] * direction
    for row, content in enumerate(values):
        pooled[row] = content
    rehash(copy)  # what an instrument would refuse, this test does on purpose
    return open_run(copy)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_a_planted_answer_is_found_exactly_where_it_lies(planted_run: Run) -> None:
    scores = train_probes(planted_run, ["shape"], permutations=20, controls=(), jobs=1).scores.set_index("site")
    best = scores["accuracy"].idxmax()
    assert best == str(PLANTED)
    assert scores.loc[best, "accuracy"] == 1.0
    assert scores.loc[best, "p_fwe"] < 0.05
    other_sites = scores.drop(index=best).query("stream == 'backbone'")
    assert (other_sites["p_fwe"] >= 0.05).all()
    (row,) = (row for row in retention_table([planted_run]).rows if row.category == "shape")
    assert row.retention.defined
    assert (row.backbone.verdict, row.backbone.score, row.backbone.peak) == ("shown", 1.0, 1.0)
    assert row.backbone.ci is not None
    assert row.backbone.ci[1] == 1.0
    assert row.backbone.layer == PLANTED.layer
    assert row.run.random_weights


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is not sealed")
def test_with_shuffled_labels_nothing_is_significant(planted_run: Run) -> None:
    results = train_probes(planted_run, ["color"], permutations=20, target="side.shuffled", controls=(), jobs=1)
    assert (results.scores["p_fwe"] >= 0.05).all()
