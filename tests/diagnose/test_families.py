"""A diagnosis of every family that acts: it works, or says what the family lacks."""

from pathlib import Path
from typing import get_args

import pytest

from probe_kit.diagnose.diagnosis import diagnose_run
from probe_kit.diagnose.results import Verdict
from probe_kit.errors import UsageError
from probe_kit.extract import ExtractSettings, extract_run
from probe_kit.suite import Suite
from tests.support.acting_checkpoints import FAMILIES

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:the model put out tokens that"),  # random weights do
]


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_that_acts_is_diagnosed_or_says_what_it_lacks(
    family: str, small_suite: Suite, tmp_path: Path
) -> None:
    tiny = FAMILIES[family]
    settings = ExtractSettings(
        family,
        tiny.prepare_checkpoint(small_suite, tmp_path / "checkpoint"),
        options=tiny.options,
        suite=small_suite.folder,
        capture_only=True,
        accept_units=True,
        accept_ignored_inputs=True,
        env_workers=0,
    )
    run = extract_run(settings, tmp_path / "run")
    try:
        diagnosis = diagnose_run(run, frames=6, seed=1)
    except UsageError as error:
        # An untrained network may always choose the same bins.
        if "actions are equal" not in str(error):
            raise
        return
    for diagnosed in diagnosis.inputs:
        assert diagnosed.verdict in get_args(Verdict)
        assert diagnosed.matters is None or diagnosed.where, "sites, or why there are none"
    assert any(diagnosed.matters is not None for diagnosed in diagnosis.inputs)
