"""A LoRA fine-tune is its base plus what it learned, in every family; what cannot be merged is refused by name."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from peft import LoraConfig, get_peft_model
from safetensors.torch import load_file, save_file
from torch import nn

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks import Observation, load_model, load_policy
from probe_kit.hooks.checkpoints.checkpoint import INDEX_FILE, WEIGHTS_FILE
from probe_kit.hooks.checkpoints.folders import adapter_in
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.families.magma.network import shipped_statistics
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.registry import find_family
from probe_kit.models.embedded import embedded_checkpoint
from tests.support.every_checkpoint import WRITERS, families

NAME = "model.state_proj.weight"
RANDOM = {"probe_kit.weights": "random, seed 0"}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A copy of the embedded checkpoint that a test may damage."""
    return Path(shutil.copytree(embedded_checkpoint("pi0-tiny"), tmp_path / "checkpoint"))


def rewrite(checkpoint: Path, change: dict[str, torch.Tensor | None]) -> None:
    tensors = load_file(checkpoint / WEIGHTS_FILE)
    for name, tensor in change.items():
        tensors.pop(name, None)
        if tensor is not None:
            tensors[name] = tensor
    save_file(tensors, checkpoint / WEIGHTS_FILE, metadata=RANDOM)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({NAME: None}, "1 tensors missing: model.state_proj.weight"),
        ({"model.extra": torch.zeros(2)}, "not part of the model: model.extra"),
        ({NAME: torch.zeros(64, 9)}, r"of another shape: model.state_proj.weight \(64, 9\) instead of \(64, 8\)"),
        ({NAME: torch.full((64, 8), torch.nan)}, "NaN or infinite: model.state_proj.weight"),
        ({NAME: None, "model.state_prjo.weight": torch.zeros(64, 8)}, "missing: model.state_proj.weight"),
    ],
    ids=["deleted", "added", "mis-shaped", "nan", "renamed"],
)
def test_a_changed_file_is_refused_by_tensor_name(checkpoint: Path, change, complaint: str) -> None:
    rewrite(checkpoint, change)
    with pytest.raises(WeightsError, match=complaint) as caught:
        Pi0.load(str(checkpoint))
    assert caught.value.exit_code == 3


def test_missing_weights_are_refused_and_not_replaced_by_random_ones(checkpoint: Path) -> None:
    (checkpoint / WEIGHTS_FILE).unlink()
    with pytest.raises(WeightsError, match="no weights in"):
        Pi0.load(str(checkpoint))


def test_a_truncated_file_is_refused(checkpoint: Path) -> None:
    file = checkpoint / WEIGHTS_FILE
    file.write_bytes(file.read_bytes()[:-1000])
    with pytest.raises(WeightsError, match="cannot be read"):
        Pi0.load(str(checkpoint))


def test_a_dead_output_head_may_be_absent_and_is_listed(checkpoint: Path) -> None:
    head = "model.paligemma_with_expert.gemma_expert.lm_head.weight"
    rewrite(checkpoint, {head: None})
    assert Pi0.load(str(checkpoint)).card.audit["allowed_missing"] == (head,)


def test_shards_load_like_one_file(checkpoint: Path) -> None:
    card = Pi0.load(str(checkpoint)).card
    shard(checkpoint)
    assert Pi0.load(str(checkpoint)).card.weights_sha256 == card.weights_sha256


def test_a_missing_shard_is_named(checkpoint: Path) -> None:
    shard(checkpoint)
    (checkpoint / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(WeightsError, match=r"model-00002-of-00002\.safetensors is missing"):
        Pi0.load(str(checkpoint))


def test_an_index_that_contradicts_its_shards_is_refused(checkpoint: Path) -> None:
    shard(checkpoint)
    index = json.loads((checkpoint / INDEX_FILE).read_text(encoding="utf-8"))
    del index["weight_map"][NAME]
    (checkpoint / INDEX_FILE).write_text(json.dumps(index), encoding="utf-8")
    with pytest.raises(WeightsError, match=f"disagree about {NAME}"):
        Pi0.load(str(checkpoint))


def test_the_hash_names_every_bit(checkpoint: Path) -> None:
    before = read_weights(checkpoint).sha256()
    tensor = load_file(checkpoint / WEIGHTS_FILE)[NAME]
    tensor[0, 0] = torch.nextafter(tensor[0, 0], torch.tensor(torch.inf))
    rewrite(checkpoint, {NAME: tensor})
    assert read_weights(checkpoint).sha256() != before


@pytest.mark.slow
def test_the_random_mark_travels_in_the_weights_file(checkpoint: Path) -> None:
    save_file(load_file(checkpoint / WEIGHTS_FILE), checkpoint / WEIGHTS_FILE, metadata=RANDOM)
    assert Pi0.load(str(checkpoint)).card.random_weights
    save_file(load_file(checkpoint / WEIGHTS_FILE), checkpoint / WEIGHTS_FILE)
    assert not Pi0.load(str(checkpoint)).card.random_weights
    assert Pi0.load(str(checkpoint), random_weights=True).card.random_weights


def shard(checkpoint: Path) -> None:
    """Split the single file in two, as large checkpoints are."""
    tensors = load_file(checkpoint / WEIGHTS_FILE)
    names = sorted(tensors)
    halves = {"model-00001-of-00002.safetensors": names[::2], "model-00002-of-00002.safetensors": names[1::2]}
    for file, half in halves.items():
        save_file({name: tensors[name] for name in half}, checkpoint / file, metadata=RANDOM)
    weight_map = {name: file for file, half in halves.items() for name in half}
    (checkpoint / INDEX_FILE).write_text(json.dumps({"weight_map": weight_map}), encoding="utf-8")
    (checkpoint / WEIGHTS_FILE).unlink()


def test_a_checkpoint_in_the_layout_of_early_2025_acts_like_todays(
    checkpoint: Path, pi0_tiny: Pi0, observation: Observation
) -> None:
    """lerobot's own loader returns a random backbone for such a file."""
    vlm = "model.paligemma_with_expert.paligemma"
    tensors = load_file(checkpoint / WEIGHTS_FILE)
    old = {
        name.replace(f"{vlm}.model.language_model.", f"{vlm}.language_model.model.").replace(
            f"{vlm}.model.vision_tower.", f"{vlm}.vision_tower."
        ): tensor
        for name, tensor in tensors.items()
    }
    assert old.keys() != tensors.keys()
    save_file(old, checkpoint / WEIGHTS_FILE, metadata=RANDOM)
    np.testing.assert_array_equal(
        Pi0.load(str(checkpoint)).act([observation], [1]), pi0_tiny.act([observation], [1])
    )


def test_a_file_that_holds_the_embedding_only_as_lm_head_loads_it_from_there(checkpoint: Path) -> None:
    vlm = "model.paligemma_with_expert.paligemma"
    embedding = f"{vlm}.model.language_model.embed_tokens.weight"
    head = load_file(checkpoint / WEIGHTS_FILE)[f"{vlm}.lm_head.weight"]
    rewrite(checkpoint, {embedding: None})
    assert torch.equal(Pi0.load(str(checkpoint)).network.state_dict()[embedding], head)


def test_a_loaded_policy_is_in_eval_mode(checkpoint: Path) -> None:
    assert not Pi0.load(str(checkpoint)).network.training


def test_a_pickled_state_dict_is_read_without_running_code(checkpoint: Path, tmp_path: Path) -> None:
    plain_hash = Pi0.load(str(checkpoint)).card.weights_sha256
    tensors = load_file(checkpoint / WEIGHTS_FILE)
    (checkpoint / WEIGHTS_FILE).unlink()
    torch.save(tensors, checkpoint / "model.pt")
    assert Pi0.load(str(checkpoint)).card.weights_sha256 == plain_hash
    torch.save({"trap": Path(tmp_path)}, checkpoint / "model.pt")
    with pytest.raises(WeightsError, match="plain tensors"):
        Pi0.load(str(checkpoint))


@pytest.mark.parametrize(
    ("before", "prefix"),
    [
        ("_orig_mod.", "_orig_mod."),
        ("module.", "module."),
        ("module._orig_mod.", "module._orig_mod."),
        ("policy.", "policy."),
        ("agent.policy.", "agent.policy."),
    ],
)
def test_a_name_in_front_of_all_tensors_is_told(checkpoint: Path, before: str, prefix: str) -> None:
    tensors = {before + name: tensor for name, tensor in load_file(checkpoint / WEIGHTS_FILE).items()}
    save_file(tensors, checkpoint / WEIGHTS_FILE)
    with pytest.raises(WeightsError, match=f"names hold '{prefix}'.*save its tensors again without") as caught:
        Pi0.load(str(checkpoint))
    assert "missing" not in str(caught.value)


def test_a_wrapper_inside_the_names_is_told(checkpoint: Path) -> None:
    tensors = {name.replace("layers.0.", "layers.0._checkpoint_wrapped_module."): tensor
               for name, tensor in load_file(checkpoint / WEIGHTS_FILE).items()}  # fmt: skip
    save_file(tensors, checkpoint / WEIGHTS_FILE)
    with pytest.raises(WeightsError, match="_checkpoint_wrapped_module"):
        Pi0.load(str(checkpoint))


def write_index(checkpoint: Path, shard: str) -> None:
    names = dict.fromkeys(load_file(checkpoint / WEIGHTS_FILE), shard)
    (checkpoint / INDEX_FILE).write_text(json.dumps({"weight_map": names}), encoding="utf-8")


def test_two_sets_of_weights_are_refused_because_nothing_says_which_is_meant(checkpoint: Path) -> None:
    write_index(checkpoint, "model-00001-of-00001.safetensors")
    shutil.copy(checkpoint / WEIGHTS_FILE, checkpoint / "model-00001-of-00001.safetensors")
    for load in (read_weights, lambda folder: Pi0.load(str(folder))):
        with pytest.raises(WeightsError, match="two sets of weights"):
            load(checkpoint)


def test_an_index_that_lists_the_one_file_is_no_second_set(checkpoint: Path) -> None:
    write_index(checkpoint, WEIGHTS_FILE)
    assert read_weights(checkpoint).tensors


RANK, ALPHA = 2, 6
PLACE = "model.paligemma_with_expert.gemma_expert.model.layers.0.self_attn.q_proj"


def network_of(model: Any) -> nn.Module:
    """The module whose tensors were audited."""
    network = getattr(model, "network", None)
    assert isinstance(network, nn.Module)
    return network


def without_weights(base: Path, folder: Path) -> Path:
    """A copy of a checkpoint of which an adapter's files are to take the place of the weights."""
    weights = shutil.ignore_patterns("model*.safetensors", "model.safetensors.index.json", "*.pt")
    return Path(shutil.copytree(base, folder, ignore=weights))


def write_adapter(folder: Path, tensors: dict[str, torch.Tensor], base: str, **fields: Any) -> Path:
    """Two files as peft saves them."""
    save_file(tensors, folder / "adapter_model.safetensors")
    settings = {
        "peft_type": "LORA", "r": RANK, "lora_alpha": ALPHA, "target_modules": ["q_proj"], "bias": "none",
        "base_model_name_or_path": base, **fields,
    }  # fmt: skip
    (folder / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    return folder


def factors(module: str, weight: torch.Tensor, seed: int = 0) -> dict[str, torch.Tensor]:
    """Low-rank factors of a linear layer under peft's names."""
    generator = torch.Generator().manual_seed(seed)
    down = torch.randn((RANK, weight.shape[1]), generator=generator)
    up = torch.randn((weight.shape[0], RANK), generator=generator)
    name = f"base_model.model.{module}"
    return {f"{name}.lora_A.weight": down, f"{name}.lora_B.weight": up}


def last_linear(network: nn.Module) -> str:
    """The path of a linear layer whose weight is not tied to another's."""
    shared = [id(parameter) for _, parameter in network.named_parameters(remove_duplicate=False)]
    return [
        name
        for name, module in network.named_modules()
        if type(module) is nn.Linear and shared.count(id(module.weight)) == 1
    ][-1]


@pytest.mark.parametrize("family", families())
def test_weights_that_are_overwritten_in_place_leave_a_loaded_model_as_it_is(family: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    folder = write(tmp_path / "current")
    network = network_of(load_model(family, str(folder), **options))
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    for file in folder.rglob("*.safetensors"):
        content = bytearray(file.read_bytes())
        content[-len(content) // 2 :] = bytes(len(content) // 2)
        with file.open("r+b") as opened:  # as rsync --inplace and cp do
            opened.write(content)
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())


@pytest.mark.slow
@pytest.mark.parametrize("family", families())
def test_an_adapter_is_added_to_the_weights_of_the_base_in_every_family(family: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    base = write(tmp_path / "base")
    plain = load_model(family, str(base), **options)
    before = {name: tensor.clone() for name, tensor in network_of(plain).state_dict().items()}
    module = last_linear(network_of(plain))
    adapter_factors = factors(module, before[f"{module}.weight"])
    tuned = write_adapter(without_weights(base, tmp_path / "tuned"), adapter_factors, str(base))

    model = load_model(family, str(tuned), **options)

    down, up = adapter_factors.values()
    changed = {
        name: tensor
        for name, tensor in network_of(model).state_dict().items()
        if not torch.equal(tensor, before[name])
    }
    assert list(changed) == [f"{module}.weight"]
    expected = before[f"{module}.weight"].double() + ALPHA / RANK * up.double() @ down.double()
    torch.testing.assert_close(changed[f"{module}.weight"].double(), expected, atol=1e-4, rtol=1e-2)
    assert model.card.weights_sha256 != plain.card.weights_sha256
    assert f"LoRA adapter merged into {base}" in model.card.notes


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """A base, and a folder with its files besides the weights."""
    base = Path(shutil.copytree(embedded_checkpoint("pi0-tiny"), tmp_path / "base"))
    return base, without_weights(base, tmp_path / "tuned")


def weights_of(base: Path) -> dict[str, torch.Tensor]:
    return load_file(base / "model.safetensors")


def test_the_hash_covers_the_base_the_factors_and_how_they_are_scaled(folders: tuple[Path, Path]) -> None:
    base, tuned = folders
    adapter_factors = factors(PLACE, weights_of(base)[f"{PLACE}.weight"])
    other = factors(PLACE, weights_of(base)[f"{PLACE}.weight"], seed=1)
    hashes = [
        load_model("pi0", str(write_adapter(tuned, tensors, "../base", lora_alpha=alpha))).card.weights_sha256
        for tensors, alpha in ((adapter_factors, 6), (adapter_factors, 7), (other, 6), (adapter_factors, 6))
    ]
    assert len(set(hashes)) == 3
    assert hashes[0] == hashes[3]


@pytest.mark.slow
@pytest.mark.parametrize("fields", [{"use_rslora": True}, {"use_dora": True}, {"alpha_pattern": {"q_proj": 3}}])
def test_the_other_ways_of_scaling_give_what_peft_computes(
    folders: tuple[Path, Path], tmp_path: Path, fields: dict[str, Any]
) -> None:
    base, tuned = folders
    network = load_model("pi0", str(base)).network
    config = LoraConfig(r=RANK, lora_alpha=ALPHA, target_modules=[PLACE], **fields)
    wrapped = get_peft_model(network, config)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in wrapped.named_parameters():
            if "lora_" in name:
                parameter.copy_(torch.rand(parameter.shape, generator=generator))
    wrapped.save_pretrained(tmp_path / "saved")
    for file in (tmp_path / "saved").glob("adapter_*"):
        shutil.copy(file, tuned)
    settings = json.loads((tuned / "adapter_config.json").read_text(encoding="utf-8"))
    (tuned / "adapter_config.json").write_text(
        json.dumps({**settings, "base_model_name_or_path": "../base"}), encoding="utf-8"
    )
    expected = wrapped.merge_and_unload().get_submodule(PLACE).weight
    weight = load_model("pi0", str(tuned)).network.get_submodule(PLACE).weight
    torch.testing.assert_close(weight, expected.detach())
    assert not torch.allclose(weight, weights_of(base)[f"{PLACE}.weight"])


def test_a_layer_that_was_trained_whole_replaces_the_bases(folders: tuple[Path, Path]) -> None:
    base, tuned = folders
    trained_layer = torch.full_like(weights_of(base)["model.state_proj.weight"], 0.25)
    tensors = {
        **factors(PLACE, weights_of(base)[f"{PLACE}.weight"]),
        "base_model.model.model.state_proj.weight": trained_layer,
        "base_model.model.model.state_proj.bias": weights_of(base)["model.state_proj.bias"],
    }
    write_adapter(tuned, tensors, "../base", modules_to_save=["state_proj"])
    assert torch.equal(load_model("pi0", str(tuned)).network.model.state_proj.weight, trained_layer)


def test_an_adapter_of_todays_names_fits_a_base_of_older_ones(folders: tuple[Path, Path]) -> None:
    base, tuned = folders
    stored = weights_of(base)
    older = {name.replace("paligemma.model.language_model.", "paligemma.language_model.model."): t.contiguous()
             for name, t in stored.items()}  # fmt: skip
    assert older.keys() != stored.keys()
    module = "model.paligemma_with_expert.paligemma.model.language_model.layers.0.self_attn.q_proj"
    adapter_factors = factors(module, stored[f"{module}.weight"])
    write_adapter(tuned, adapter_factors, "../base")
    first = load_model("pi0", str(tuned)).network.get_submodule(module).weight
    save_file(older, base / "model.safetensors")
    assert torch.equal(load_model("pi0", str(tuned)).network.get_submodule(module).weight, first)


def change(folder: Path, file: str, **fields: Any) -> None:
    path = folder / file
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | fields), encoding="utf-8")


REFUSED: dict[str, tuple[Callable[[Path, Path], Any], str]] = {
    "weights beside it": (
        lambda base, tuned: shutil.copy(base / "model.safetensors", tuned),
        r"holds weights and a LoRA adapter of '../base'.*base_model_name_or_path to '\.'",
    ),
    "use_peft alone": (
        lambda _, tuned: (
            [file.unlink() for file in tuned.glob("adapter_*")] and change(tuned, "config.json", use_peft=True)
        ),
        "says use_peft: true",
    ),
    "no settings": (lambda _, tuned: (tuned / "adapter_config.json").unlink(), "no adapter_config.json"),
    "no tensors": (lambda _, tuned: (tuned / "adapter_model.safetensors").unlink(), "but neither adapter_model"),
    "another kind": (lambda _, tuned: change(tuned, "adapter_config.json", peft_type="IA3"), "only LORA"),
    "another start": (
        lambda _, tuned: change(tuned, "adapter_config.json", init_lora_weights="pissa"),
        "init_lora_weights: 'pissa'",
    ),
    "copied layers": (
        lambda _, tuned: change(tuned, "adapter_config.json", layer_replication=[[0, 2]]),
        "layer_replication",
    ),
    "a revision": (lambda _, tuned: change(tuned, "adapter_config.json", revision="1a2b3c"), "revision: '1a2b3c'"),
    "a newer field": (
        lambda _, tuned: change(tuned, "adapter_config.json", new_in_peft=0.5),
        "new_in_peft: 0.5",
    ),
    "an adapter as its base": (
        lambda base, tuned: shutil.copy(tuned / "adapter_config.json", base),
        "is an adapter itself",
    ),
    "no base": (
        lambda _, tuned: change(tuned, "adapter_config.json", base_model_name_or_path="/nowhere"),
        "base_model_name_or_path in its adapter_config.json",
    ),
    "a lost layer": (
        lambda _, tuned: change(tuned, "adapter_config.json", modules_to_save=["state_proj"]),
        "has no tensors of state_proj",
    ),
}


@pytest.mark.parametrize("kind", list(REFUSED))
def test_an_adapter_that_cannot_be_merged_exactly_is_refused_by_name(
    folders: tuple[Path, Path], kind: str
) -> None:
    base, tuned = folders
    write_adapter(tuned, factors(PLACE, weights_of(base)[f"{PLACE}.weight"]), "../base")
    damage, message = REFUSED[kind]
    damage(base, tuned)
    with pytest.raises((CheckpointError, WeightsError), match=message):
        load_model("pi0", str(tuned))


def test_weights_that_the_adapter_names_as_its_base_are_merged(folders: tuple[Path, Path]) -> None:
    base, _ = folders
    before = weights_of(base)[f"{PLACE}.weight"]
    write_adapter(base, factors(PLACE, before), ".")
    assert not torch.allclose(load_model("pi0", str(base)).network.get_submodule(PLACE).weight, before)


def test_factors_of_another_model_are_refused(folders: tuple[Path, Path]) -> None:
    base, tuned = folders
    other = PLACE.replace("layers.0", "layers.99")
    write_adapter(tuned, factors(other, weights_of(base)[f"{PLACE}.weight"]), "../base")
    with pytest.raises(WeightsError, match=r"layers\.99.*belongs to another model"):
        load_model("pi0", str(tuned))


def test_factors_among_the_weights_are_named(folders: tuple[Path, Path]) -> None:
    base, _ = folders
    tensors = weights_of(base)
    weight = tensors.pop(f"{PLACE}.weight")
    save_file(
        {**tensors, f"{PLACE}.base_layer.weight": weight, f"{PLACE}.lora_A.default.weight": weight[:2].clone()},
        base / "model.safetensors",
    )
    with pytest.raises(WeightsError, match="1 low-rank factors that were not merged"):
        load_model("pi0", str(base))


def test_an_adapter_in_a_folder_below_is_pointed_to(folders: tuple[Path, Path]) -> None:
    base, tuned = folders
    (tuned / "adapter").mkdir()
    write_adapter(tuned / "adapter", factors(PLACE, weights_of(base)[f"{PLACE}.weight"]), "../../base")
    with pytest.raises(WeightsError, match=r"tuned/adapter, which holds an adapter"):
        load_model("pi0", str(tuned))


def test_a_folder_without_an_adapter_has_none(folders: tuple[Path, Path]) -> None:
    assert adapter_in(folders[0]) is None


@pytest.mark.parametrize(
    "family", [pytest.param(name, marks=[pytest.mark.slow] * (name != "pi0")) for name in families()]
)
def test_an_adapter_alone_is_its_base_plus_what_it_learned_in_every_family(family: str, tmp_path: Path) -> None:
    """As with the base's small files beside it: the same weights, streams and settings."""
    write, options = WRITERS[family]
    base = write(tmp_path / "base")
    plain = load_model(family, str(base), **options)
    module = last_linear(network_of(plain))
    adapter_factors = factors(module, network_of(plain).state_dict()[f"{module}.weight"])
    adapter = write_adapter(without_weights(base, tmp_path / "beside"), adapter_factors, str(base))
    (tmp_path / "alone").mkdir()
    alone = write_adapter(tmp_path / "alone", adapter_factors, str(base))

    card = load_model(family, str(alone), **options).card

    expected = load_model(family, str(adapter), **options).card
    assert card.weights_sha256 == expected.weights_sha256 != plain.card.weights_sha256
    assert card.settings == expected.settings
    assert card.checkpoint == str(alone)
    assert f"LoRA adapter merged into {base}" in card.notes
    assert not any("probe-kit-adapter" in note for note in card.notes)
    untrained = load_model(family, str(alone), random_weights=True, **options)
    assert untrained.card.settings == expected.settings


def doubled(values: Any) -> Any:
    """The same JSON with every number of a statistic twice as large."""
    if isinstance(values, dict):
        return {name: value if name == "mask" else doubled(value) for name, value in values.items()}
    if isinstance(values, list):
        return [doubled(value) for value in values]
    return values * 2 if isinstance(values, float) else values


def read(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


def openvlas(base: Path) -> Any:
    return doubled(read(base / "config.json")["norm_stats"])


def xiaomis(base: Path) -> Any:
    content = read(base / "preprocessor_config.json")
    return {**content, "action_config": doubled(content["action_config"])}


def spatialvlas(base: Path) -> Any:
    content = read(base / "processor_config.json")
    return {**content, "statistics": doubled(content["statistics"])}


STATISTICS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "openvla": ("dataset_statistics.json", openvlas),
    "magma": ("dataset_statistics.json", lambda _: doubled(dict(shipped_statistics()))),
    "internvla-m1": ("dataset_statistics.json", lambda base: doubled(read(base / "dataset_statistics.json"))),
    "xiaomi-r0": ("preprocessor_config.json", xiaomis),
    "spatialvla": ("processor_config.json", spatialvlas),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
@pytest.mark.parametrize("family", list(STATISTICS))
def test_statistics_in_the_folder_of_an_adapter_replace_its_bases(family: str, tmp_path: Path) -> None:
    write, options = WRITERS[family]
    base = write(tmp_path / "base")
    first = chunk(family, base, options)
    file, content = STATISTICS[family]
    alone = without_effect(family, base, tmp_path / "alone", options)
    np.testing.assert_array_equal(chunk(family, alone, options), first)
    (alone / file).write_text(json.dumps(content(base)), encoding="utf-8")
    np.testing.assert_allclose(chunk(family, alone, options), 2 * first, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["pi05", "molmoact2", "smolvla"])
@pytest.mark.parametrize("with_steps", [True, False])
def test_tensors_of_processors_in_the_folder_of_an_adapter_replace_its_bases(
    family: str, with_steps: bool, tmp_path: Path
) -> None:
    write, options = WRITERS[family]
    base = write(tmp_path / "base")
    first = chunk(family, base, options)
    alone = without_effect(family, base, tmp_path / "alone", options)
    (file,) = base.glob("policy_postprocessor*.safetensors")
    save_file({name: 2 * data if data.is_floating_point() else data for name, data in load_file(file).items()},
              alone / file.name)  # fmt: skip
    if with_steps:
        shutil.copy(base / "policy_postprocessor.json", alone)
    np.testing.assert_allclose(chunk(family, alone, options), 2 * first, rtol=1e-4, atol=1e-6)


def chunk(family: str, folder: Path, options: dict[str, Any]) -> Any:
    """The first three numbers of the actions of one inference."""
    policy = load_policy(family, str(folder), **options)
    observation = Observation(
        image=np.full((64, 64, 3), 90, np.uint8),
        state=np.zeros(8, np.float32),
        instruction="red",
        intrinsics=np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1]], np.float32),
    )
    return policy.act([observation], [3])[..., :3]


def without_effect(family: str, base: Path, folder: Path, options: dict[str, Any]) -> Path:
    """An adapter alone whose factors add nothing."""
    plain = load_model(family, str(base), **options)
    module = last_linear(network_of(plain))
    adapter_factors = factors(module, network_of(plain).state_dict()[f"{module}.weight"])
    folder.mkdir()
    return write_adapter(folder, {name: 0 * tensor for name, tensor in adapter_factors.items()}, str(base))


@pytest.mark.parametrize("family", ["pi0", "openvla", "xvla", "magma", "spatialvla"])
@pytest.mark.parametrize("untrained", [False, True])
def test_an_adapter_whose_base_is_not_here_is_refused_by_name(
    family: str, untrained: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("probe_kit.hooks.checkpoints.checkpoint.unreachable", lambda: "offline mode")
    alone = tmp_path / "tuned"
    alone.mkdir()
    write_adapter(alone, factors("q_proj", torch.zeros(4, 4)), "lab/base")
    with pytest.raises(CheckpointError, match=r"was trained on 'lab/base'.*Correct base_model_name_or_path"):
        load_model(family, str(alone), random_weights=untrained)


def test_an_adapter_whose_base_has_no_configuration_is_refused_by_name(tmp_path: Path) -> None:
    for name in ("base", "tuned"):
        (tmp_path / name).mkdir()
    write_adapter(tmp_path / "tuned", factors("q_proj", torch.zeros(4, 4)), "../base")
    with pytest.raises(CheckpointError, match=r"without config\.json, and its base .*base has none either.*copy"):
        load_model("pi0", str(tmp_path / "tuned"))


@pytest.mark.parametrize(
    ("base", "message"),
    [
        ("{folder}/tuned", "its base .*tuned has none either"),
        ("../tuned", "its base .*tuned has none either"),
        ("../other", "other of the LoRA adapter .* is an adapter itself"),
    ],
)
def test_adapters_whose_bases_lead_back_to_them_are_refused_by_name_in_plan_and_run(
    base: str, message: str, tmp_path: Path
) -> None:
    adapter_factors = factors("q_proj", torch.zeros(4, 4))
    for name, base_path in (("tuned", base.format(folder=tmp_path)), ("other", "../tuned")):
        (tmp_path / name).mkdir()
        write_adapter(tmp_path / name, adapter_factors, base_path)
    for read in (find_family("pi0").outline, find_family("pi0").load):
        with pytest.raises(CheckpointError, match=message):
            read(str(tmp_path / "tuned"))


def test_the_outline_follows_every_file_of_a_folder_and_passes_over_links_to_nothing(tmp_path: Path) -> None:
    write, options = WRITERS["internvla-m1"]
    model_folder, family = write(tmp_path / "model"), find_family("internvla-m1")
    first = family.outline(str(model_folder), options)
    folder = model_folder if model_folder.is_dir() else model_folder.parent
    (folder / "left.json").symlink_to(tmp_path / "nothing")
    assert family.outline(str(model_folder), options) is first
    configuration = folder / "config.yaml"
    configuration.write_text(configuration.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    assert family.outline(str(model_folder), options) is not first
