"""A study of two scripted models that was played, for tests of what is made of stored runs."""

import pytest

from probe_kit.study import LoadedStudy, conduct_study, load_study, plan_study
from probe_kit.suite import Suite
from tests.study.small_study import small_study

PLAYED = """
schema = 1
name = "scripted"
out = "{out}"

[suite]
path = "{suite}"
categories = ["color"]
items = 2

[models.expert]
family = "expert"

[models.idle]
family = "idle"
label = "Idle"

[conditions.short]
max_steps = 1

[conditions.dark]
max_steps = 1
light_level = 0.7

[[runs]]
name = "main"
models = ["expert", "idle"]
conditions = ["short"]

[[runs]]
name = "light"
models = ["idle"]
conditions = ["dark"]

[comparisons.light]
pairs = {{ conditions = ["short", "dark"], models = ["idle"] }}

[tables.main]
kind = "success"
runs = ["main"]

[tables.sides]
kind = "sides"
runs = ["main"]

[tables.score]
kind = "score"
runs = ["main"]
elsewhere = {{ title = "LIBERO %", source = "a paper", values = {{ idle = 1.5 }} }}

[tables.light]
kind = "ablation"
comparison = "light"

[figures.overview]
kind = "overview"
runs = ["main"]

[figures.sides]
kind = "sides"
runs = ["main"]

[figures.curves]
kind = "curves"
runs = ["main"]

[figures.dose]
kind = "dose"
runs = ["main"]
"""


@pytest.fixture(scope="session")
def played(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> LoadedStudy:
    """Whole, without probes."""
    study = load_study(small_study(tmp_path_factory.mktemp("played"), small_suite, PLAYED))
    assert conduct_study(plan_study(study), env_workers=0) == []
    return study
