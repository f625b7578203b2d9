"""The best sites in a few columns, ties and first iteration included."""

from dataclasses import replace

import numpy as np
import pytest

from probe_kit.hooks import Site
from probe_kit.train import ProbeCurve, ProbeResults, ProbeSettings
from probe_kit.train.results.best_sites import best_sites, site_cells
from probe_kit.train.results.summary import best_sites_findings, best_sites_sentences, best_sites_table

SITES = {
    Site("backbone", 0): 0.5, Site("backbone", 1): 0.9, Site("backbone", 2): 0.9,
    Site("expert", 0, "residual", 0): 0.6, Site("expert", 1, "residual", 0): 0.5,
    Site("expert", 0, "residual", 1): 0.8, Site("expert", 1, "residual", 1): 0.7,
}  # fmt: skip


def curve(lower: float = 0.0) -> ProbeCurve:
    """Decisions about 40 episodes, of which each site has a share right."""
    labels = np.tile([True, False], 20)
    right = np.stack([np.arange(40) < round(40 * (share - lower)) for share in SITES.values()])
    names = np.array([f"g{number // 4}" for number in range(40)])
    return ProbeCurve(
        sites=tuple(SITES), labels=labels, episodes=np.arange(40).astype(str), items=names, groups=names,
        fold_of=np.arange(40) // 4 % 5, decisions=np.where(right == labels, 1.0, -1.0),
        strengths=np.ones((len(SITES), 5)), null=np.full((len(SITES), 9), 0.5),
        inner=np.zeros((len(SITES), 5, 10), np.float32),
    )  # fmt: skip


@pytest.fixture
def results() -> ProbeResults:
    settings = ProbeSettings(
        "m", False, None, "s@1#0", "s@1#0", "0", "0", ("color",), ("mean",), "side.correct", permutations=9, seed=0
    )
    return ProbeResults(settings, {("color", "mean"): curve()})


def test_the_first_of_the_best_is_named_with_its_ties_and_the_first_iteration(results: ProbeResults) -> None:
    backbone, expert = best_sites(results.scores, True)
    assert site_cells(backbone, True)[0] == "backbone.01.residual +1"
    assert site_cells(backbone, True)[1].startswith("90.0 [")
    assert site_cells(backbone, True)[2:] == ("50.0", "0.100")
    assert site_cells(expert, True)[0] == "expert.00.residual@1"
    assert expert["first"] == pytest.approx(0.6)
    assert backbone["first"] != backbone["first"], "the stream runs once"


def test_categories_do_not_mix(results: ProbeResults) -> None:
    both = replace(
        results,
        settings=replace(results.settings, categories=("shape", "color")),
        curves={("shape", "mean"): curve(0.2), **results.curves},
    )
    rows = best_sites(both.scores, True)
    assert [row["category"] for row in rows] == ["color", "color", "shape", "shape"]
    assert [round(row["score"], 2) for row in rows] == [0.9, 0.8, 0.7, 0.6]
    assert [row["ties"] for row in rows] == [1, 0, 1, 0]
    assert [row[0] for row in best_sites_table([both]).texts] == ["color", "color", "shape", "shape"]


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (9, "not testable in the backbone and the action expert: train with --permutations 20 or more"),
        (200, "not testable in the backbone and the action expert: extract more items"),
    ],
)
def test_what_no_p_can_show_says_whether_permutations_or_groups_are_too_few(
    results: ProbeResults, asked: int, sentence: str
) -> None:
    """The null of these probes has nine columns: of as many as were asked for, or of all that the groups allow."""
    stored = replace(results, settings=replace(results.settings, permutations=asked))
    assert best_sites_findings(stored) == [f"Color  {sentence}."]
    (line,) = best_sites_sentences(stored)
    assert line.count(sentence.rpartition(": ")[2]) == 2, line
