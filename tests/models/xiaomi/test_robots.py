import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.models.xiaomi import read_units
from tests.support.xiaomi_checkpoints import NUMBERS, action_config


def write(folder: Path, content: dict[str, Any]) -> Path:
    (folder / "preprocessor_config.json").write_text(json.dumps({"action_config": content}), encoding="utf-8")
    return folder


def test_the_beginning_of_one_name_is_enough_and_the_file_gives_the_chunk_its_length(tmp_path: Path) -> None:
    folder = write(tmp_path, action_config())
    units = read_units(folder, "bridge", NUMBERS)
    assert (units.robot, units.mean.shape) == ("bridge_delta", (4, NUMBERS))
    assert read_units(folder, "libero", NUMBERS).mean.shape == (10, NUMBERS)
    assert read_units(folder, "fractal_delta", NUMBERS).sha256 != units.sha256


def test_the_only_robot_needs_no_name(tmp_path: Path) -> None:
    assert read_units(write(tmp_path, action_config({"mine": 2})), None, NUMBERS).robot == "mine"


def test_numbers_the_robot_does_not_have_are_masked(tmp_path: Path) -> None:
    used = read_units(write(tmp_path, action_config()), "bridge", NUMBERS).used
    assert used[:, :7].all()
    assert not used[:, 7:].any()


def test_actions_are_restored_step_by_step(tmp_path: Path) -> None:
    units = read_units(write(tmp_path, action_config()), "bridge", NUMBERS)
    ones = np.ones((1, 4, NUMBERS), np.float32)
    np.testing.assert_allclose(units.restore(ones)[0], units.mean + units.deviation)


def test_an_unknown_or_ambiguous_robot_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    folder = write(tmp_path, action_config({"calvin_abc_orig": 2, "calvin_abcd_orig": 2}))
    for name in ("widowx", "calvin_abc", None):
        with pytest.raises(UsageError, match="calvin_abc_orig, calvin_abcd_orig"):
            read_units(folder, name, NUMBERS)


def test_statistics_that_do_not_fit_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="action_config"):
        read_units(write(tmp_path, {}), None, NUMBERS)
    with pytest.raises(CheckpointError, match=r"\(steps, 31\)"):
        read_units(write(tmp_path, action_config()), "bridge", 31)
    content = action_config()
    content["bridge_delta"]["std"][0][0] = float("nan")
    with pytest.raises(CheckpointError, match="finite"):
        read_units(write(tmp_path, content), "bridge", NUMBERS)
