import re
from dataclasses import replace

import pytest

from probe_kit.hooks.contract.sites import Site
from probe_kit.train import ProbeResults, train_probes
from probe_kit.train.results.control_scores import ControlScore
from probe_kit.train.results.summary import best_sites_findings, best_sites_sentences
from tests.train.conftest import PlantedRun


def with_pixels(results: ProbeResults, p: float) -> ProbeResults:
    scores = [
        ControlScore("pixels", category, 0.81, (0.7, 0.9), p, 0.5, 48) for category in results.settings.categories
    ]
    return replace(results, controls=results.controls.with_scores(scores))


@pytest.mark.slow
@pytest.mark.parametrize(("p", "is_named"), [(0.01, True), (0.2, False)])
def test_pictures_that_decode_the_target_alone_are_named(
    planted_run: PlantedRun, p: float, is_named: bool
) -> None:
    run = planted_run({Site("backbone", 3): 1.0}, categories=("color", "shape"))
    results = train_probes(run, permutations=9)
    sentences = [one for one in best_sites_sentences(with_pixels(results, p)) if "episodes): " in one]
    assert len(sentences) == 2
    assert all(("The pictures alone decode it too (81 %, 70 to 90)." in one) == is_named for one in sentences)


def test_the_last_lines_are_short_sentences_of_two_numbers_without_brackets(planted_run: PlantedRun) -> None:
    run = planted_run({Site("backbone", 3): 1.0}, categories=("color", "public-info"))
    results = with_pixels(train_probes(run, permutations=39), 0.01)
    lines = [line for line in best_sites_findings(results) if "was not run" not in line]
    assert [line[:13] for line in lines] == ["Color        ", "Public Info  "]
    assert lines[0].startswith("Color        decodable in the backbone at ")
    for line in lines:
        assert line.endswith("; the pictures alone decode it too.")
        assert len(line.split()) <= 25
        assert len(re.findall(r"\d+", line)) <= 2
        assert not re.search(r"[][()]", line)
