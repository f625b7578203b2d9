"""Drift, curves and their archive, from a study file to the table: two embedded policies that capture alone."""

from pathlib import Path

import pytest

from probe_kit.study import conduct_study, fit_probes, load_study, make_figures, make_table, pack_study, plan_study

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

[conditions.captured]
no_act = true

[[runs]]
name = "main"
models = ["base", "early"]
conditions = ["captured"]

[probes.main]
runs = ["main"]
permutations = 39

[drift.training]
pairs = [["early", "base"], ["base", "base/captured"]]

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
    assert [cells[:2] for cells in made.text.cells] == [
        ("early → base", "Color"), ("early → base", "Counting"),
        ("base → base", "Color"), ("base → base", "Counting"),
    ]  # fmt: skip
    color, counting = made.text.cells[2:]
    assert (color[2], counting[2]) == ("kept", "not shown in either")
    assert color[4] == color[5].split()[0] == color[6], "a run transfers to itself as it decodes"
    assert color[12] == "1.00"
    chosen = make_table(study, "counting").text.cells
    assert [cells[1] for cells in chosen] == ["Counting", "Counting"]
    assert chosen[0] == made.text.cells[1], "probes are those of the whole runs"
    (curves,) = make_figures(study, "curves")
    with curves.drawn() as figure:
        titles = [axes.get_title(loc="left") for axes in figure.axes if axes.get_visible()]
    assert all(title.startswith("Color") for title in titles)
    pack_study(study, tmp_path / "study.zip")
    assert make_table(load_study(tmp_path / "study.zip"), "drift").text == made.text
