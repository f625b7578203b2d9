import json
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file
from torch import nn

from probe_kit._system.imports import install_command
from probe_kit.errors import CheckpointError, MissingExtraError, UsageError, WeightsError
from probe_kit.hooks.families.openvla.adapter import load_openvla
from probe_kit.hooks.families.prismatic.checkpoint import load_checkpoint, quantise
from probe_kit.models.prismatic import PrismaticNetwork
from tests.support.prismatic_checkpoints import write_checkpoint

TARGETS = ["q_proj", "v_proj", "fc1", "qkv"]  # language model, projector and both towers


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("base"))


@pytest.fixture
def adapter(base: Path, tmp_path: Path) -> Path:
    """A trained-looking LoRA adapter, written by peft itself."""
    wrapped = get_peft_model(load(base), LoraConfig(r=4, lora_alpha=8, target_modules=TARGETS))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in wrapped.named_parameters():
            if "lora_" in name:
                parameter.copy_(torch.randn(parameter.shape, generator=generator) / 10)
    wrapped.save_pretrained(tmp_path / "adapter")
    change(tmp_path / "adapter", base_model_name_or_path=str(base))
    return tmp_path / "adapter"


def change(folder: Path, **fields: object) -> None:
    file = folder / "adapter_config.json"
    file.write_text(json.dumps(json.loads(file.read_text(encoding="utf-8")) | fields), encoding="utf-8")


def load(folder: Path) -> PrismaticNetwork:
    return load_checkpoint(str(folder), "cpu", None, random_weights=False).network


def test_shards_give_the_same_weights_and_the_same_hash_as_one_file(base: Path, tmp_path: Path) -> None:
    sharded = load_checkpoint(str(write_checkpoint(tmp_path, shards=3)), "cpu", None, random_weights=False)
    whole = load_checkpoint(str(base), "cpu", None, random_weights=False)
    assert sharded.audit == whole.audit
    for name, tensor in whole.network.state_dict().items():
        assert torch.equal(sharded.network.state_dict()[name], tensor)


def test_a_head_with_other_numbers_than_the_embedding_that_it_is_tied_to_is_refused(
    base: Path, tmp_path: Path
) -> None:
    shutil.copytree(base, tmp_path, dirs_exist_ok=True)
    values = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    values["text_config"]["tie_word_embeddings"] = True
    (tmp_path / "config.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(WeightsError, match=r"lm_head\.weight differs from the tensor .* ties it to"):
        load(tmp_path)


# -- LoRA --------------------------------------------------------------------------------------------------------


def test_an_adapter_is_merged_exactly_where_it_belongs(base: Path, adapter: Path) -> None:
    """Every changed weight is W + (alpha / r) B A, computed here from the files."""
    merged, original = load(adapter).state_dict(), load_file(base / "model.safetensors")
    low_rank = load_file(adapter / "adapter_model.safetensors")
    assert merged.keys() == original.keys()
    changed = set()
    for key, down in low_rank.items():
        if ".lora_A." in key:
            up = low_rank[key.replace("lora_A", "lora_B")]
            name = key.removeprefix("base_model.model.").replace(".lora_A", "")
            torch.testing.assert_close(merged[name], original[name] + 2 * up @ down)
            changed.add(name)
    assert {name.partition(".")[0] for name in changed} == {"language_model", "projector", "vision_backbone"}
    for name in original.keys() - changed:
        assert torch.equal(merged[name], original[name])


def test_an_adapter_has_a_hash_of_its_own_and_its_card_names_the_base(base: Path, adapter: Path) -> None:
    card = load_openvla(str(adapter)).card
    assert card.weights_sha256 != load_openvla(str(base)).card.weights_sha256
    assert any("LoRA" in note and str(base) in note for note in card.notes)


def test_an_adapters_base_may_be_named_relative_to_it(base: Path, adapter: Path) -> None:
    shutil.copytree(base, adapter.parent / "beside")
    change(adapter, base_model_name_or_path="../beside")
    assert load_openvla(str(adapter)).card.checkpoint == str(adapter)


def test_a_base_that_cannot_be_found_says_where_it_is_named(adapter: Path) -> None:
    change(adapter, base_model_name_or_path="/nowhere/at/all")
    with pytest.raises(CheckpointError, match=r"base_model_name_or_path in its adapter_config\.json"):
        load(adapter)


@pytest.mark.parametrize("damage", ["deleted", "elsewhere", "whole", "nan", "mis-shaped"])
def test_an_adapter_that_does_not_fit_is_refused(adapter: Path, damage: str) -> None:
    file = adapter / "adapter_model.safetensors"
    tensors = load_file(file)
    name = next(key for key in tensors if "lora_B" in key)
    original = tensors.pop(name)
    if damage == "elsewhere":
        tensors[name.replace("layers.0", "layers.7").replace("blocks.0", "blocks.7")] = original
    elif damage == "whole":
        tensors |= {name: original, "base_model.model.projector.fc1.weight": original.clone()}
    elif damage == "nan":
        tensors[name] = torch.full_like(original, torch.nan)
    elif damage == "mis-shaped":
        tensors[name] = original[:, :1].clone()
    save_file(tensors, file)
    with pytest.raises(WeightsError):
        load(adapter)


def test_another_kind_of_adapter_is_refused(adapter: Path) -> None:
    change(adapter, peft_type="IA3")
    with pytest.raises(CheckpointError, match="only LORA"):
        load(adapter)


def test_heads_of_openvla_oft_are_noticed(base: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(base, tmp_path / "oft"))
    (copy / "action_head--150000_checkpoint.pt").write_bytes(b"")
    with pytest.raises(CheckpointError, match="OpenVLA-OFT"):
        load(copy)


# -- quantised ---------------------------------------------------------------------------------------------------


def test_quantised_weights_need_the_extra(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    with pytest.raises(MissingExtraError, match=re.escape(install_command("quantized"))):
        load_openvla(str(base), bits=4)


def test_quantised_weights_need_a_gpu(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bitsandbytes", ModuleType("bitsandbytes"))
    with pytest.raises(UsageError, match="need an NVIDIA GPU"):
        load_openvla(str(base), bits=8)
    with pytest.raises(UsageError, match="expected 8 or 4"):
        load_openvla(str(base), bits=3)


def test_a_quantised_model_is_marked_as_not_exact(base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Packing needs a GPU; what is marked does not."""
    where = "probe_kit.hooks.families.prismatic.checkpoint."
    monkeypatch.setattr(f"{where}check_quantisation", lambda *_: None)
    monkeypatch.setattr(f"{where}quantise", lambda *_: None)
    card = load_openvla(str(base), bits=4).card
    assert not card.exact
    assert card.dtype == "float32, 4-bit"
    assert any("not exact" in note for note in card.notes)


@pytest.mark.parametrize(("bits", "layer"), [(8, "Linear8bitLt"), (4, "Linear4bit")])
def test_only_linear_layers_inside_the_decoders_blocks_are_replaced(
    base: Path, monkeypatch: pytest.MonkeyPatch, bits: int, layer: str
) -> None:
    """With bitsandbytes' names standing for plain layers that remember how they were asked for."""

    class Plain(nn.Linear):
        def __init__(self, inputs: int, outputs: int, bias: bool, **_: object) -> None:
            super().__init__(inputs, outputs, bias=bias)

    library = ModuleType("bitsandbytes")
    library.nn = ModuleType("bitsandbytes.nn")
    setattr(library.nn, layer, Plain)
    for name in ("Int8Params", "Params4bit"):
        setattr(library.nn, name, lambda data, **_: nn.Parameter(data, requires_grad=False))
    monkeypatch.setitem(sys.modules, "bitsandbytes", library)
    network = load(base)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    quantise(network, bits)
    replaced = {name for name, module in network.named_modules() if isinstance(module, Plain)}
    blocks = [f"language_model.model.layers.{index}." for index in range(2)]
    assert len(replaced) == 2 * 7
    assert all(name.startswith(tuple(blocks)) for name in replaced)
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, before[name])
