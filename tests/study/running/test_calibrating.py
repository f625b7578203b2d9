"""Rates that `--calibrate` measures, of models without a network."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.study import Ledger, calibrate_study, load_study, plan_study
from probe_kit.suite import Suite

TEXT = """
schema = 1
name = "measured"
out = "{out}"
[suite]
path = "{suite}"
categories = ["color"]
items = 4
[models.expert]
family = "expert"
[conditions.short]
max_steps = 2
[conditions.long]
max_steps = 4
[[runs]]
name = "main"
models = ["expert"]
conditions = ["short", "long"]
"""


@pytest.fixture
def file(small_suite: Suite, tmp_path: Path) -> Path:
    path = tmp_path / "study.toml"
    path.write_text(TEXT.format(out=tmp_path / "out", suite=small_suite.folder), encoding="utf-8")
    return path


@pytest.mark.slow
def test_a_model_is_measured_once_and_the_plan_has_its_hours_and_their_source(file: Path, tmp_path: Path) -> None:
    begun: list[str] = []
    assert calibrate_study(plan_study(load_study(file)), begun.append, env_workers=0) == []
    assert begun == ["expert, acting"]
    speed = Ledger(str(tmp_path / "out")).speeds()["expert, acting"]
    assert (speed.episodes, speed.batch, speed.tokens) == (8, 1, "pooled")
    cost = plan_study(load_study(file)).cost
    assert cost.sources == {"expert": "calibrated"}
    assert cost.seconds["expert/short"] == pytest.approx(8 * 2 * speed.seconds)
    assert cost.seconds["expert/long"] == pytest.approx(8 * 4 * speed.seconds)
    assert calibrate_study(plan_study(load_study(file)), begun.append) == []
    assert len(begun) == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["ledger"]
    shown = CliRunner().invoke(app, ["study", "run", str(file), "--dry-run", "--calibrate", "--json"])
    assert json.loads(shown.stdout)["hours_from"] == {"expert": "calibrated"}
