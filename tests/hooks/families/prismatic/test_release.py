"""TRI-ML's release: a folder per model in one repository, a .pt file in parts, towers and tokenizer elsewhere."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import timm
import torch
from timm.layers import resample_abs_pos_embed

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks import Prompt
from probe_kit.hooks.checkpoints.checkpoint import hub_name
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.prismatic.adapter import Prismatic, load_prismatic
from probe_kit.hooks.registry import find_family
from probe_kit.models.prismatic import PrismaticConfig
from tests.support.prismatic_checkpoints import RELEASED_ID, write_checkpoint, write_release, write_tokenizer


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of the hub, which is all there is."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path / "hub"


def plain(folder: Path) -> Prismatic:
    """The same weights in the layout of transformers."""
    write_tokenizer(write_checkpoint(folder, model_type="prismatic"))
    return load_prismatic(str(folder))


@pytest.mark.parametrize("towers_inside", [False, True])
def test_a_model_of_the_release_is_the_same_model(
    cache: Path, tmp_path: Path, observation: Observation, towers_inside: bool
) -> None:
    write_release(cache, towers_inside=towers_inside)
    ours, theirs = load_prismatic(), plain(tmp_path / "plain")
    expected, found = theirs.network.state_dict(), ours.network.state_dict()
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert ours.card.weights_sha256 == theirs.card.weights_sha256
    question = [Prompt(observation, "put the cube on the star", (" red", " shape"))]
    np.testing.assert_array_equal(ours.read(question).option_logits, theirs.read(question).option_logits)
    assert ours.card.checkpoint == RELEASED_ID
    assert "file tokenizer/tokenizer.json" in ours.card.settings


def test_positions_of_a_tower_are_resampled_as_timm_does_it(cache: Path) -> None:
    write_release(cache, published_side=56)
    found = load_prismatic().network.vision_backbone.featurizer.pos_embed
    stored = torch.randn((1, 16, 16), generator=torch.Generator().manual_seed(1))
    network = timm.create_model("vit_large_patch14_reg4_dinov2.lvd142m", img_size=28, depth=1, embed_dim=16)
    expected = resample_abs_pos_embed(stored, [2, 2], num_prefix_tokens=0)
    assert found.shape == expected.shape == network.pos_embed.shape
    torch.testing.assert_close(found, expected)


def test_a_folder_of_the_release_loads_as_the_id_does(cache: Path) -> None:
    folder = write_release(cache)
    assert load_prismatic(str(folder)).card.weights_sha256 == load_prismatic().card.weights_sha256
    assert checkpoint_folder(RELEASED_ID) == folder
    find_family("prismatic").check(str(folder))
    assert find_family("prismatic").location(None) == RELEASED_ID


def test_no_other_model_of_the_repository_is_asked_for(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repository of several hundred GB: what is asked for lies in one folder."""
    folder = write_release(cache)
    asked: list[tuple[str, list[str]]] = []

    def download(name: str, allow_patterns: list[str], **_: object) -> str:
        asked.append((name, allow_patterns))
        return str(folder.parent)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "")
    find_family("prismatic").check(None)
    ((repository, patterns),) = asked
    assert repository == "TRI-ML/prismatic-vlms"
    assert all(pattern.startswith("prism-dinosiglip-224px+7b/") for pattern in patterns)
    assert "prism-dinosiglip-224px+7b/checkpoints/latest-checkpoint.pt" in patterns


@pytest.mark.parametrize(
    ("checkpoint", "expected"),
    [
        ("a/b", ("a/b", "", "")), ("a/b/c+7b", ("a/b", "c+7b", "")), ("a/b/c/d", None), ("./a/b", None),
        ("/a/b", None), ("a//b", None), ("a", None), ("a/b@v1.0", ("a/b", "", "v1.0")), ("a/b@", None),
        ("a/b@refs/pr/3", ("a/b", "", "refs/pr/3")), ("a/b/c@main", ("a/b", "c", "main")), ("@main", None),
    ],
)  # fmt: skip
def test_ids_of_the_hub(checkpoint: str, expected: tuple[str, str, str] | None) -> None:
    assert hub_name(checkpoint) == expected


def test_a_folder_that_the_repository_lacks_is_named(cache: Path) -> None:
    write_release(cache)
    with pytest.raises(CheckpointError, match="has no folder 'prism-none'"):
        checkpoint_folder("TRI-ML/prismatic-vlms/prism-none")


def test_a_tower_that_is_not_there_is_named_with_its_repository(cache: Path) -> None:
    write_release(cache)
    shutil.rmtree(cache / "models--timm--vit_so400m_patch14_siglip_224.webli")
    with pytest.raises(CheckpointError, match=r"timm/vit_so400m_patch14_siglip_224\.webli"):
        load_prismatic()


def test_code_in_the_file_is_not_run(cache: Path, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (open, (str(tmp_path / "ran"), "w"))  # type: ignore[return-value]

    file = write_release(cache) / "checkpoints" / "latest-checkpoint.pt"
    torch.save({"model": Evil()}, file)
    with pytest.raises(WeightsError, match="damaged or unsafe"):
        load_prismatic()
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"state": {}}, "holds dict under `model`"),
        ({"model": {"projector": {"projector.0.weight": torch.zeros(2)}}}, "expected llm_backbone, projector"),
        ({"model": {"projector": {"projector.7.weight": torch.zeros(2)}, "llm_backbone": {"llm.x": 0}}},
         "'projector.7.weight' is no tensor of a known part"),
    ],
)  # fmt: skip
def test_a_file_of_another_layout_is_refused(cache: Path, content: object, said: str) -> None:
    torch.save(content, write_release(cache) / "checkpoints" / "latest-checkpoint.pt")
    with pytest.raises(WeightsError, match=said):
        load_prismatic()


def test_another_projector_is_refused(cache: Path) -> None:
    file = write_release(cache) / "config.json"
    values = json.loads(file.read_text(encoding="utf-8"))
    values["model"]["arch_specifier"] = "linear"
    file.write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"arch_specifier is 'linear'; expected fused-gelu-mlp"):
        load_prismatic()


@pytest.mark.parametrize(
    ("language", "width", "layers", "vocabulary"),
    [("llama2-7b-pure", 4096, 32, 32064), ("vicuna-v15-13b", 5120, 40, 32064), ("phi-2-3b", 2560, 32, 50304),
     ("mistral-v0.1-7b-instruct", 4096, 32, 32064)],
)  # fmt: skip
def test_a_run_names_the_published_language_model(language: str, width: int, layers: int, vocabulary: int) -> None:
    """The run's file has no part for it; the training code took the published configuration."""
    run = {"vision_backbone_id": "clip-vit-l-336px", "llm_backbone_id": language, "arch_specifier": "gelu-mlp"}
    config = PrismaticConfig.from_json({"model": {**run, "image_resize_strategy": "letterbox"}})
    text = config.text
    assert (text.hidden_size, text.num_hidden_layers, text.vocab_size) == (width, layers, vocabulary)
    eps = getattr(text, "rms_norm_eps", None) or text.layer_norm_eps
    assert (eps, config.dtype) == (1e-5, "bfloat16")
    assert config.tokenizer_id is not None
