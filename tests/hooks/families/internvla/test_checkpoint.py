import json
import pickle
import shutil
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks import Observation
from probe_kit.hooks.families.internvla.adapter import load_internvla
from probe_kit.hooks.families.internvla.checkpoint import RELEASED_STEP, convert, find_parts
from tests.support.internvla_checkpoints import write_checkpoint, write_vlm

NAME = "steps_7_pytorch_model.pt"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("internvla"))


def test_the_run_its_folder_of_weights_and_the_file_are_the_same_checkpoint(run: Path) -> None:
    places = (run, run / "checkpoints", run / "checkpoints" / NAME)
    parts = [find_parts(str(place), None) for place in places]
    assert {part.weights for part in parts} == {run / "checkpoints" / NAME}
    assert {part.run for part in parts} == {run}
    assert {part.vlm for part in parts} == {run.parent / "vlm"}


def test_of_several_weights_one_has_to_be_named(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    shutil.copy(copy / "checkpoints" / NAME, copy / "checkpoints" / "steps_8_pytorch_model.pt")
    with pytest.raises(CheckpointError, match=r"steps_7.*steps_8.*-M weights=FILE.*--checkpoint"):
        find_parts(str(copy), None)
    assert find_parts(str(copy), None, "steps_8_pytorch_model.pt").weights.name == "steps_8_pytorch_model.pt"
    with pytest.raises(CheckpointError, match=r"no weights 'steps_9.pt'; choose .* steps_7.*steps_8"):
        find_parts(str(copy), None, "steps_9.pt")
    shutil.copy(copy / "checkpoints" / NAME, copy / "checkpoints" / RELEASED_STEP)
    assert find_parts(str(copy), None).weights.name == RELEASED_STEP
    assert find_parts(str(copy), None, unread=True).weights == copy
    assert find_parts(str(copy / "checkpoints" / NAME), None).weights.name == NAME
    shutil.rmtree(copy / "checkpoints")
    with pytest.raises(CheckpointError, match="no weights"):
        find_parts(str(copy), None)


def test_a_runs_configuration_may_be_json(run: Path, tmp_path: Path, observation: Observation) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    values = yaml.safe_load((copy / "config.yaml").read_text(encoding="utf-8"))
    (copy / "config.yaml").unlink()
    (copy / "dims.json").rename(copy / "aside")
    with pytest.raises(CheckpointError, match=r"config\.yaml or config\.json of a run is missing"):
        find_parts(str(copy), None)
    (copy / "aside").rename(copy / "dims.json")
    (copy / "config.json").write_text(json.dumps(values), encoding="utf-8")
    one, other = (load_internvla(str(folder), steps=5, unnorm_key="bridge_dataset") for folder in (run, copy))
    np.testing.assert_array_equal(one.act([observation], [3]), other.act([observation], [3]))
    assert f"weights of {NAME}" in other.card.notes


def test_of_the_hub_one_step_is_downloaded(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the hub does it: only files that match a pattern come."""
    there = Path(shutil.copytree(run, tmp_path / "hub"))
    steps = [f"steps_{number}_pytorch_model.pt" for number in (10000, 30000, 50000)]
    for name in steps:
        shutil.copy(there / "checkpoints" / NAME, there / "checkpoints" / name)
    (there / "checkpoints" / NAME).unlink()
    here = tmp_path / "cache"

    def download(_name: str, allow_patterns: list[str], **_: object) -> str:
        files = (file for file in there.rglob("*") if file.is_file())
        for file in files:
            path = file.relative_to(there).as_posix()
            if any(fnmatch(path, pattern) for pattern in allow_patterns):
                (here / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(file, here / path)
        return str(here)

    listed = [file.relative_to(there).as_posix() for file in there.rglob("*") if file.is_file()]
    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", lambda _, _name, **_further: listed)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "")
    assert find_parts("some/run", None, unread=True).weights == here
    assert not list(here.rglob("*.pt"))
    assert find_parts("some/run", None).weights == here / "checkpoints" / RELEASED_STEP
    assert [file.name for file in here.rglob("*.pt")] == [RELEASED_STEP]
    find_parts("some/run", None, steps[0])
    assert sorted(file.name for file in here.rglob("*.pt")) == sorted([steps[0], RELEASED_STEP])


def test_a_vision_language_model_can_be_named_and_has_to_be_one(run: Path, tmp_path: Path) -> None:
    other = write_vlm(tmp_path / "other")
    assert find_parts(str(run), str(other)).vlm == other
    (other / "config.json").write_text(json.dumps({"model_type": "qwen3_vl"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="qwen2_5_vl"):
        find_parts(str(run), str(other))


class _Harm:
    """Runs a command when it is unpickled the unsafe way."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return eval, (f"open({str(self.trace)!r}, 'w').close()",)


def test_a_file_that_would_run_code_runs_none(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    trace = tmp_path / "trace"
    torch.save({"weight": _Harm(trace)}, copy / "checkpoints" / NAME)
    with pytest.raises(WeightsError, match="unsafe"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")
    (copy / "checkpoints" / NAME).write_bytes(pickle.dumps(_Harm(trace), protocol=2))
    with pytest.raises(WeightsError, match="unsafe"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")
    assert not trace.exists()


def test_missing_and_extra_tensors_are_named(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    file = copy / "checkpoints" / NAME
    state = torch.load(file, weights_only=True)
    state["dino_pro.other"] = state.pop("dino_pro.bias")
    torch.save(state, file)
    with pytest.raises(WeightsError, match=r"missing.*dino_pro\.bias"):
        load_internvla(str(copy), unnorm_key="bridge_dataset")


def test_the_stored_precision_is_kept(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    file = copy / "checkpoints" / NAME
    torch.save({name: t.to(torch.bfloat16) for name, t in torch.load(file, weights_only=True).items()}, file)
    assert load_internvla(str(run), unnorm_key="bridge_dataset").card.dtype == "float32"
    assert load_internvla(str(copy), unnorm_key="bridge_dataset").card.dtype == "bfloat16"
    assert load_internvla(str(copy), dtype="float32", unnorm_key="bridge_dataset").card.dtype == "float32"


def test_a_converted_folder_is_whole_and_has_the_same_hash_and_actions(
    run: Path, tmp_path: Path, observation: Observation
) -> None:
    original = load_internvla(str(run), steps=5, unnorm_key="bridge_dataset")
    assert convert(str(run), tmp_path / "out") == original.card.weights_sha256
    copy = load_internvla(str(tmp_path / "out"), steps=5, unnorm_key="bridge_dataset")
    assert copy.parts.vlm == copy.parts.run == tmp_path / "out"
    assert copy.card.weights_sha256 == original.card.weights_sha256
    np.testing.assert_array_equal(copy.act([observation], [3]), original.act([observation], [3]))
    with pytest.raises(UsageError, match="exists"):
        convert(str(run), tmp_path / "out")


@pytest.mark.slow
def test_the_converter_is_a_command(run: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "probe_kit.hooks.families.internvla.checkpoint"]
    done = subprocess.run(
        [*command, str(run), str(tmp_path / "out")], capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.strip()) == 64
    refused = subprocess.run(
        [*command, str(tmp_path / "no"), "x"], capture_output=True, encoding="utf-8", check=False
    )
    assert refused.returncode != 0
    assert "does not exist" in refused.stderr
    assert "Traceback" not in refused.stderr
