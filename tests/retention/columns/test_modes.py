"""A model that was asked is described as answering, a policy as acting, wherever the same sentence stands."""

import html
import re
from collections.abc import Mapping
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from probe_kit.retention import retention_table
from probe_kit.retention.displays import (
    KnowledgeActionDisplay,
    SideTableDisplay,
    SuccessTableDisplay,
    collect_figures,
)
from probe_kit.retention.report import report_html
from probe_kit.train import save_results
from tests.retention.asked_runs import SaidRun, acted, asked, probes

RIGHT = {"color": np.random.default_rng(0).random((20, 2)) < 0.85}
OF_POLICIES = re.compile(
    r"\bcube\b|\bhand\b|success rate|\bSR\b|never moved|outcome rule|the policy|ended on", re.I
)


def vlm(path: Path) -> SaidRun:
    run = asked(path, RIGHT)
    save_results(probes(run, {"color": [0.5, 0.9]}), run.location)
    return run


def text_of(page: str) -> str:
    """What a reader can see or point at; the page's own code serves both kinds of run."""
    page = re.sub(r"<style>.*?</style>|<script>.*?</script>", "", page, flags=re.DOTALL)
    return html.unescape(page)


def formats(runs: list[SaidRun]) -> Mapping[str, str]:
    table = retention_table(runs)
    console = Console(width=220, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    exhibits = collect_figures(runs, table)
    return {
        "terminal": console.export_text(),
        "markdown": table.to_markdown(),
        "latex": table.to_latex("all"),
        "notebook": table._repr_html_(),
        "report": text_of(report_html(runs, table)),
        "captions": "\n".join(f"{one.title}: {one.reading}" for one in exhibits),
        "figures": "\n".join(words for one in exhibits for words in written(one.draw())),
    }


def written(figure) -> list[str]:  # type: ignore[no-untyped-def]
    """All words of a figure."""
    from matplotlib.text import Text

    return [found.get_text() for found in figure.findobj(Text)]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """One with probes, and one without, of which a note says so."""
    folder = tmp_path_factory.mktemp("asked")
    return formats([vlm(folder), asked(folder / "plain", RIGHT, "vlm-tiny")])


FORMATS = ("terminal", "markdown", "latex", "notebook", "report", "captions", "figures")


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_of_answers_is_never_described_as_acting(shown: Mapping[str, str], name: str) -> None:
    assert shown[name]
    assert [line for line in shown[name].splitlines() if OF_POLICIES.search(line)] == []


@pytest.mark.parametrize("name", FORMATS)
def test_a_run_of_answers_is_described_as_answering(shown: Mapping[str, str], name: str) -> None:
    assert re.search(r"accuracy of answers|answers right", shown[name], re.I)


def test_the_summary_says_how_many_answers_are_right(shown: Mapping[str, str]) -> None:
    share = 100 * RIGHT["color"].mean()
    assert f"the VLM answers right in {share:.0f}\u00a0%" in shown["report"]


@pytest.mark.slow
def test_a_policy_is_described_as_before_and_a_mixture_as_both(tmp_path: Path) -> None:
    policy = acted(tmp_path, RIGHT)
    alone, both = formats([policy]), formats([policy, vlm(tmp_path)])
    assert "the cube ends on the correct picture in" in alone["report"]
    assert "the VLM answers right in" not in alone["report"]
    assert "the cube ends on the correct picture in" in both["report"]
    assert "the VLM answers right in" in both["report"]
    for name in FORMATS:
        assert re.search(r"success rate", alone[name], re.I), name
        assert not re.search(r"accuracy of answers", alone[name], re.I), name
        assert re.search(r"accuracy of answers", both[name], re.I), name


def test_axes_and_titles_name_the_share_they_show(tmp_path: Path) -> None:
    table = retention_table([vlm(tmp_path)])
    assert SuccessTableDisplay.from_table(table).title == "Accuracy of answers (%)"
    assert SideTableDisplay.from_table(table).title.startswith("Accuracy of answers (%) where")
    axes = KnowledgeActionDisplay.from_table(table).plot().ax_
    assert axes is not None
    assert axes.get_ylabel() == "accuracy of answers (%)"


def test_answers_that_cannot_be_read_are_no_cube_that_missed(tmp_path: Path) -> None:
    run = asked(tmp_path, RIGHT)
    run.episodes["outcome"] = "oob"
    run.episodes["side_placed"] = "none"
    page = text_of(report_html([run]))
    assert "No answer could be read in 100.0 % of episodes" in page
    assert "reached neither picture" not in page
