import gzip
import json
from pathlib import Path

import pytest
import torch
from lerobot.policies.pi0 import modeling_pi0

from probe_kit.errors import CheckpointError
from probe_kit.models.building import initialise
from probe_kit.models.embedded.tiny import SIZE, _config
from probe_kit.models.pi0 import Pi0Size, build_pi0


def test_lerobots_module_is_left_as_found() -> None:
    before = dict(vars(modeling_pi0))
    build_pi0(_config(), SIZE)
    assert dict(vars(modeling_pi0)) == before


def test_the_policy_is_lerobots_own_class_in_eval_mode() -> None:
    policy = build_pi0(_config(), SIZE)
    assert type(policy) is modeling_pi0.PI0Policy
    assert not policy.training


def test_a_seed_means_the_same_weights_every_time() -> None:
    first, second, other = (build_pi0(_config(), SIZE) for _ in range(3))
    for policy, seed in ((first, 1), (second, 1), (other, 2)):
        initialise(policy, seed)
    name = "model.state_proj.weight"
    assert all(torch.equal(tensor, second.state_dict()[key]) for key, tensor in first.state_dict().items())
    assert not torch.equal(first.state_dict()[name], other.state_dict()[name])


def test_full_size_has_the_recorded_names_and_shapes(golden_pi0: Path) -> None:
    """On the meta device: nothing is allocated."""
    recorded = json.loads(gzip.decompress((golden_pi0 / "real_keys.json.gz").read_bytes()))["keys"]
    state = build_pi0(modeling_pi0.PI0Config(device="cpu"), device="meta").state_dict()
    assert {n: list(t.shape) for n, t in state.items()} == {n: entry["shape"] for n, entry in recorded.items()}


def test_an_incomplete_size_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dims.json").write_text(json.dumps({"vlm": {"width": 8}}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="does not describe pi0"):
        Pi0Size.from_file(tmp_path / "dims.json")
