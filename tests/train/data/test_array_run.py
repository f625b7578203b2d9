from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from probe_kit.errors import UnknownSiteError, UsageError
from probe_kit.hooks import Site, Stream
from probe_kit.train import ArrayRun

PlantedRun = Callable[..., ArrayRun]


def test_streams_are_read_off_the_sites(planted_run: PlantedRun) -> None:
    assert planted_run().streams == {
        "backbone": Stream("backbone", 5, 20),
        "expert": Stream("expert", 2, 8, iterations=2),
    }


def test_other_features_are_another_run(planted_run: PlantedRun) -> None:
    assert planted_run().settings_sha256 == planted_run().settings_sha256
    assert planted_run().settings_sha256 != planted_run({Site("backbone", 0): 1.0}).settings_sha256


def test_a_row_per_episode_is_required(planted_run: PlantedRun, tmp_path: Path) -> None:
    features = {(Site("backbone", 0), "mean"): np.zeros((3, 4))}
    with pytest.raises(UsageError, match=r"expected \(80, D\)"):
        ArrayRun(tmp_path, "mine", "suite@1#0", planted_run().episodes, features)


def test_a_row_per_episode_is_required_of_controls_too(planted_run: PlantedRun, tmp_path: Path) -> None:
    controls = {"words": np.zeros((3, 4))}
    with pytest.raises(
        UsageError, match=r"features of the control 'words' have shape \(3, 4\); expected \(80, D\)"
    ):
        ArrayRun(tmp_path, "mine", "suite@1#0", planted_run().episodes, {}, control_features=controls)


def test_a_missing_site_is_an_error(planted_run: PlantedRun) -> None:
    with pytest.raises(UnknownSiteError, match=r"backbone\.09\.residual"):
        planted_run().column(Site("backbone", 9), "mean")
