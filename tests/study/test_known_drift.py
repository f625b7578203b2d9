"""Drift of the embedded policy by its training, whose truth is known, on three drawn suites."""

from pathlib import Path

import pytest

from probe_kit.study import conduct_study, fit_probes, load_study, make_table, plan_study
from probe_kit.suite import build_suite

TEXT = """
schema = 1
name = "known"
out = "{out}"

[suite]
path = "{suite}"

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
views = ["mean:language"]
permutations = 79
controls = ["random-features"]

[drift.training]
pairs = [["early", "base"]]
view = "mean:language"

[tables.drift]
kind = "drift"
drift = "training"
"""
TRUTH = {"color": "kept", "state": "kept", "traffic": "forgotten", "counting": "not shown in either"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_training_keeps_what_it_used_and_forgets_traffic(seed: int, tmp_path: Path) -> None:
    suite = build_suite(tmp_path / "suite", list(TRUTH), items_per_category=24, seed=seed)
    file = tmp_path / "study.toml"
    file.write_text(TEXT.format(out=tmp_path / "out", suite=suite.folder), encoding="utf-8")
    study = load_study(file)
    assert conduct_study(plan_study(study)) == []
    assert fit_probes(plan_study(study)) == []
    made = make_table(study, "drift")
    print(made.to_markdown())
    assert {one["category"]: one["verdict"] for one in made.numbers if "verdict" in one} == TRUTH
