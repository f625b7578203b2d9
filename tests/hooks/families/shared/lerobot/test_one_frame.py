"""Checkpoints of lerobot that read several frames are refused by name: every inference is given one."""

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import CheckpointError

POLICIES = {
    "pi0": "pi0.adapter:Pi0",
    "pi05": "pi05.adapter:Pi05",
    "pi0_fast": "pi0_fast.adapter:Pi0Fast",
    "smolvla": "smolvla.adapter:SmolVLA",
}


@pytest.mark.parametrize("kind", POLICIES)
def test_a_checkpoint_that_reads_several_frames_is_refused(kind: str, tmp_path: Path) -> None:
    module, name = POLICIES[kind].split(":")
    policy: Any = getattr(import_module(f"probe_kit.hooks.families.{module}"), name)
    for frames in (1, 2):
        (tmp_path / "config.json").write_text(json.dumps({"type": kind, "n_obs_steps": frames}), encoding="utf-8")
        if frames == 1:
            assert policy._read_config(tmp_path, policy.choice()).n_obs_steps == 1
        else:
            with pytest.raises(CheckpointError, match=r"reads the last 2 observations \(n_obs_steps\)"):
                policy._read_config(tmp_path, policy.choice())
