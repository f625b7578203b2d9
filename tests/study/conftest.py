"""A study of two scripted models that was played, for tests of what is made of stored runs."""

import pytest

from probe_kit.study import LoadedStudy, conduct_study, load_study, plan_study
from probe_kit.suite import Suite
from tests.study.small_study import LIGHT, small_study

PLAYED = (
    LIGHT.replace('family = "idle"', 'family = "idle"\nlabel = "Idle"')
    + """
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

[figures.dose]
kind = "dose"
runs = ["main"]
"""
)


@pytest.fixture(scope="session")
def played(small_suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> LoadedStudy:
    """Whole, without probes."""
    study = load_study(small_study(tmp_path_factory.mktemp("played"), small_suite, PLAYED, items=2))
    assert conduct_study(plan_study(study), env_workers=0) == []
    return study
