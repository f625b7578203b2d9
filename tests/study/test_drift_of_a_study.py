"""Drift, curves and their archive, from a study file to the table: two embedded policies that capture alone."""

from pathlib import Path

import pytest

from probe_kit.study import (
    LoadedStudy,
    conduct_study,
    fit_probes,
    load_study,
    make_figures,
    make_table,
    pack_study,
    plan_study,
)

TEXT = """
schema = 1
name = "drift"
out = "{out}"
scene = "act2answer"

[suite]
categories = ["Color", "Counting"]
items = 16

[models.base]
family = "pi0-tiny"

[models.early]
family = "pi0-tiny-early"

[models.vlm]
family = "vlm-tiny"

[asks.words]
prompt = "instruction"
picture_size = "640x480"

[asks.question]
prompt = "p2"
picture_size = "640x480"

[conditions.captured]
no_act = true

[[runs]]
name = "main"
models = ["base", "early"]
conditions = ["captured"]

[[runs]]
name = "words"
models = ["vlm"]
asks = ["words", "question"]
tokens = "pooled"

[probes.main]
runs = ["main", "words"]
views = ["mean", "mean:language"]
permutations = 39

[drift.training]
pairs = [["early", "base"], ["base", "base/captured"]]

[drift.vlm]
pairs = [["vlm/words", "early"], ["vlm/question", "early"]]

[drift.language]
pairs = [["vlm/words", "early"]]
view = "mean:language"

[tables.vlm]
kind = "drift"
drift = "vlm"

[tables.language]
kind = "drift"
drift = "language"

[tables.drift]
kind = "drift"
drift = "training"

[tables.counting]
kind = "drift"
drift = "training"
categories = ["counting"]

[figures.curves]
kind = "curves"
runs = ["main"]
categories = ["color"]
"""


@pytest.mark.slow
def test_a_file_names_pairs_and_an_archive_prints_their_table_without_activations(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(TEXT.format(out=tmp_path / "out"), encoding="utf-8")
    study = load_study(file)
    assert conduct_study(plan_study(study)) == []
    assert fit_probes(plan_study(study)) == []
    made = make_table(study, "drift")
    assert [cells[:2] for cells in made.texts] == [
        ("early → base", "Color"), ("early → base", "Counting"),
        ("base → base", "Color"), ("base → base", "Counting"),
    ]  # fmt: skip
    color, counting = made.texts[2:]
    assert (color[2], counting[2]) == ("kept", "not shown in either")
    named = dict(zip(made.columns, color, strict=True))
    assert named["forth %"] == named["back %"] == named["recentred %"], "a run transfers to itself as it decodes"
    assert named["CKA"] == "1.00"
    _check_vlm(study)
    chosen = make_table(study, "counting").texts
    assert [cells[1] for cells in chosen] == ["Counting", "Counting"]
    assert chosen[0] == made.texts[1], "probes are those of the whole runs"
    (curves,) = make_figures(study, "curves")
    with curves.drawn() as figure:
        titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert [title.partition(":")[0] for title in titles] == ["color", "color"], "backbone and action"
    pack_study(study, tmp_path / "study.zip")
    assert make_table(load_study(tmp_path / "study.zip"), "drift").texts == made.texts


def _check_vlm(study: LoadedStudy) -> None:
    """The early policy has the VLM's weights: with its words, picture and tokens, nothing differs."""
    numbers = make_table(study, "vlm").numbers
    sites = [one for one in numbers if "cka" in one]
    assert {one["before"].partition(" ")[0] for one in sites} == {"vlm"}
    assert len(sites) == 2 * 4, "of the pair with the policies' words alone"
    assert min(one["cka"] for one in sites) >= 0.999
    own = {one["category"]: one for one in numbers if "verdict" in one and not one["why_alone"]}
    assert own["color"]["verdict"] == "kept"
    assert [one["why_alone"] for one in numbers if "verdict" in one] == [None, None, "other words", "other words"]
    apart = [one["why_alone"] for one in make_table(study, "language").numbers]
    assert apart == ["other tokens"] * 2, "the last token is no word to the VLM"
