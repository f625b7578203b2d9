"""TRI-ML's release: a folder per model in one repository, a .pt file in parts, towers and tokenizer elsewhere."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import timm
import torch
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file
from timm.layers import resample_abs_pos_embed
from torch import nn

from probe_kit._system.imports import install_command
from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    MissingExtraError,
    ObservationError,
    UnknownSiteError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks import Observation, Prompt, Site, capture, load_policy
from probe_kit.hooks.checkpoints.checkpoint import hub_name
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.families.openvla.adapter import load_openvla
from probe_kit.hooks.families.prismatic.adapter import Prismatic, frame_of, load_prismatic
from probe_kit.hooks.families.prismatic.checkpoint import load_checkpoint, quantise
from probe_kit.hooks.families.prismatic.network import PrismaticConfig, PrismaticNetwork
from probe_kit.hooks.families.shared.text import FileTokenizer, find_tokenizer
from probe_kit.hooks.registry import find_family
from tests.hooks.families.prismatic.checkpoints import (
    RELEASED_ID,
    write_checkpoint,
    write_release,
    write_tokenizer,
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Prismatic:
    folder = write_checkpoint(
        tmp_path_factory.mktemp("phi"), vision="dinoclip-vit-l-336px", language="phi-2-3b", model_type="prismatic"
    )
    return load_prismatic(str(folder), steps=3)


def test_both_streams_together_are_the_hidden_states_of_one_pass(
    model: Prismatic, observation: Observation
) -> None:
    """Against transformers' own hidden states, for a language model whose block runs attention beside its MLP."""
    prompt, pixels = model.prompt("What is this?"), model.pixel_values([observation.image])
    with capture(model, [*model.sites(), *model.sites("final_norm")]) as activations:
        decoded = model.generate(pixels, [prompt])
    fed = torch.tensor([[*prompt, *decoded.ids[0, :-1].tolist()]])
    with torch.no_grad():
        expected = model.network(fed, torch.ones_like(fed, dtype=torch.bool), pixels).hidden_states
    last = len(expected) - 1
    for layer, states in enumerate(expected):
        quantity = "final_norm" if layer == last else "residual"
        parts = [activations[Site("backbone", layer, quantity)]]
        parts += [activations[Site("answer", layer, quantity, step)] for step in range(3)]
        torch.testing.assert_close(torch.cat(parts, dim=1), states, rtol=0, atol=2e-5)


def test_the_last_site_of_a_tower_is_what_the_projector_reads(model: Prismatic, observation: Observation) -> None:
    pixels = model.pixel_values([observation.image])
    sites = {name: stream.sites()[-1] for name, stream in model.further_streams.items()}
    with capture(model, sites.values()) as activations:
        model.generate(pixels, [model.prompt("What is this?")])
    towers = model.network.vision_backbone.towers
    patches = [
        activations[site][:, tower.num_prefix_tokens :] for site, tower in zip(sites.values(), towers, strict=True)
    ]
    with torch.no_grad():
        expected = model.network.vision_backbone(pixels)
    torch.testing.assert_close(torch.cat(patches, dim=2), expected, rtol=0, atol=0)


def test_roles_name_what_every_position_is(model: Prismatic, observation: Observation) -> None:
    """Beginning, patches, then a byte per letter; the last one belongs to the other stream. The frame is Phi's."""
    question = replace(observation, instruction="1+1?")
    longer = replace(observation, instruction="1+1=2+0?")
    short, long = model.roles([question, longer])["backbone"]
    patches, prompt, start = model.network.patches, len("Input: 1+1?\nOutput:"), len("Input: ")
    assert short.spans == (
        ("special", 0, 1),
        ("image.primary", 1, 1 + patches),
        ("special", 1 + patches, 1 + patches + start),
        ("language", 1 + patches + start, 1 + patches + start + 4),
        ("special", 1 + patches + start + 4, patches + prompt),
        ("padding", patches + prompt, 4 + patches + prompt),
    )
    assert len(short) == len(long)


@pytest.mark.parametrize(
    ("language", "text"),
    [
        ("llama2-7b-pure", "In: Why?\nOut:"),
        ("mistral-v0.1-7b-pure", "In: Why?\nOut:"),
        ("mistral-v0.1-7b-instruct", "[INST] Why? [/INST]"),
        ("phi-2-3b", "Input: Why?\nOutput:"),
    ],
)
def test_a_question_stands_in_the_frame_of_the_language_model(language: str, text: str) -> None:
    frame = frame_of(language)
    assert frame.around(" Why? ") == text
    start, stop = frame.question_span(" Why? ")
    assert text[start:stop] == "Why?"


@pytest.mark.parametrize("language", ["vicuna-v15-7b", "llama2-7b-chat"])
def test_chats_begin_with_their_system_prompt(language: str) -> None:
    text = frame_of(language).around("Why?")
    assert "assistant" in text
    assert text.endswith(("USER: Why? ASSISTANT:", "\n<</SYS>>\n\nWhy? [/INST]"))


def test_what_is_spoken_goes_on_from_the_prefill(tmp_path: Path, observation: Observation) -> None:
    """Against as many steps of one decoding, and without the towers being run once more."""
    folder = str(write_checkpoint(tmp_path, model_type="prismatic"))
    vlm, complete = (load_prismatic(folder, steps=steps) for steps in (1, 6))
    reading = vlm.read([Prompt(observation, "Which?", ("A", "B"))])
    decoded = complete.generate(complete.pixel_values([observation.image]), [complete.prompt("Which?")])
    with torch.inference_mode():
        spoken = reading.state.speak(6, frozenset())
    assert spoken.tolist() == decoded.ids.tolist()
    with pytest.raises(UsageError, match="does not come from this model"):
        complete.speak(reading, 3)


def test_a_reading_compares_what_may_stand_behind_the_prompt(
    model: Prismatic, tmp_path: Path, observation: Observation
) -> None:
    vlm = load_prismatic(str(write_checkpoint(tmp_path, model_type="prismatic")))
    reading = vlm.read([Prompt(observation, "Which?", ("A", "B"))])
    ids = vlm.tokenizer.encode("In: Which?\nOut:")
    logits = vlm.generate(vlm.pixel_values([observation.image]), [ids]).logits[0, 0]
    expected = logits[[3 + ord(letter) for letter in "AB"]]
    np.testing.assert_allclose(reading.option_logits[0], expected, atol=1e-6)
    np.testing.assert_allclose(reading.option_mass[0], logits.softmax(0)[[3 + 65, 3 + 66]].sum(), rtol=1e-5)
    with pytest.raises(UsageError, match="steps=1"):
        model.read([Prompt(observation, "Which?", ("A",))])


def test_a_vision_language_model_is_no_policy() -> None:
    with pytest.raises(UsageError, match="does not act"):
        load_policy("prismatic")


def test_a_prompt_that_does_not_fit_is_refused(model: Prismatic) -> None:
    with pytest.raises(InstructionError, match="this model has 256"):
        model.pack([model.prompt("word " * 60)])


def test_a_picture_of_another_type_is_refused(model: Prismatic) -> None:
    with pytest.raises(ObservationError, match="expected uint8"):
        model.pixel_values([np.zeros((4, 4, 3), np.float32)])


@pytest.mark.parametrize(
    "site", [Site("expert", 0), Site("answer", 1), Site("vision", 3), Site("backbone", 1, "mlp", 0)]
)
def test_a_site_it_does_not_have_is_refused_with_those_it_has(model: Prismatic, site: Site) -> None:
    with pytest.raises(UnknownSiteError, match="answer"):
        model.tap(site)


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
    single_file = load_checkpoint(str(base), "cpu", None, random_weights=False)
    assert sharded.audit == single_file.audit
    for name, tensor in single_file.network.state_dict().items():
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("towers_inside", [False, True])
def test_a_model_of_the_release_is_the_same_model(
    cache: Path, tmp_path: Path, observation: Observation, towers_inside: bool
) -> None:
    write_release(cache, towers_inside=towers_inside)
    ours, theirs = load_prismatic(), plain(tmp_path / "plain")
    expected, loaded = theirs.network.state_dict(), ours.network.state_dict()
    assert loaded.keys() == expected.keys()
    assert all(torch.equal(loaded[name], expected[name]) for name in expected)
    assert ours.card.weights_sha256 == theirs.card.weights_sha256
    question = [Prompt(observation, "put the cube on the star", (" red", " shape"))]
    np.testing.assert_array_equal(ours.read(question).option_logits, theirs.read(question).option_logits)
    assert ours.card.checkpoint == RELEASED_ID
    assert "file tokenizer/tokenizer.json" in ours.card.settings


def test_positions_of_a_tower_are_resampled_as_timm_does_it(cache: Path) -> None:
    write_release(cache, published_side=56)
    resampled = load_prismatic().network.vision_backbone.featurizer.pos_embed
    stored = torch.randn((1, 16, 16), generator=torch.Generator().manual_seed(1))
    network = timm.create_model("vit_large_patch14_reg4_dinov2.lvd142m", img_size=28, depth=1, embed_dim=16)
    expected = resample_abs_pos_embed(stored, [2, 2], num_prefix_tokens=0)
    assert resampled.shape == expected.shape == network.pos_embed.shape
    torch.testing.assert_close(resampled, expected)


def test_a_folder_of_the_release_loads_as_the_id_does(cache: Path) -> None:
    folder = write_release(cache)
    assert load_prismatic(str(folder)).card.weights_sha256 == load_prismatic().card.weights_sha256
    assert checkpoint_folder(RELEASED_ID) == folder
    find_family("prismatic").check(str(folder))
    assert find_family("prismatic").location(None) == RELEASED_ID


def test_no_other_model_of_the_repository_is_asked_for(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repository of several hundred GB: what is asked for lies in one folder."""
    folder = write_release(cache)
    downloads: list[tuple[str, list[str]]] = []

    def download(name: str, allow_patterns: list[str], **_: object) -> str:
        downloads.append((name, allow_patterns))
        return str(folder.parent)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "")
    find_family("prismatic").check(None)
    ((repository, patterns),) = downloads
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
    ("content", "reason"),
    [
        ({"state": {}}, "holds dict under `model`"),
        ({"model": {"projector": {"projector.0.weight": torch.zeros(2)}}}, "expected llm_backbone, projector"),
        ({"model": {"projector": {"projector.7.weight": torch.zeros(2)}, "llm_backbone": {"llm.x": 0}}},
         "'projector.7.weight' is no tensor of a known part"),
    ],
)  # fmt: skip
def test_a_file_of_another_layout_is_refused(cache: Path, content: object, reason: str) -> None:
    torch.save(content, write_release(cache) / "checkpoints" / "latest-checkpoint.pt")
    with pytest.raises(WeightsError, match=reason):
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


def test_the_first_folder_that_has_a_tokenizer_wins(tmp_path: Path) -> None:
    write_tokenizer(tmp_path / "base")
    tokenizer = find_tokenizer([tmp_path / "adapter", tmp_path / "base"], None, 1)
    assert tokenizer == FileTokenizer(tmp_path / "base", 1)


def test_a_folder_that_was_asked_for_is_the_only_place(tmp_path: Path) -> None:
    write_tokenizer(tmp_path / "base")
    with pytest.raises(CheckpointError, match="elsewhere"):
        find_tokenizer([tmp_path / "base"], str(tmp_path / "elsewhere"), 1)


def test_the_beginning_comes_from_the_tokenizers_files_before_the_models(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    assert FileTokenizer(tmp_path, 2).encode("put the cube")[0] == 1
    (tmp_path / "tokenizer_config.json").unlink()
    assert FileTokenizer(tmp_path, 2).encode("put the cube")[0] == 2
    assert FileTokenizer(tmp_path, None).encode("<s> put")[0] == 1


def test_special_tokens_are_those_the_file_declares(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    assert FileTokenizer(tmp_path, 1).special == {0, 1, 2}


def test_an_unknown_word_is_an_error_that_shows_the_tokens(tmp_path: Path) -> None:
    write_tokenizer(tmp_path)
    with pytest.raises(InstructionError, match="<unk>"):
        FileTokenizer(tmp_path, 1).encode("put the zebra")
