"""What transformers and peft saved again is read as they read it: every naming, processors in one file."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from peft import LoraConfig, PeftModel, get_peft_model
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from transformers import Qwen2VLImageProcessor

from probe_kit.errors import CheckpointError, InstructionError, WeightsError
from probe_kit.hooks import Observation, Prompt, load_model
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.families.shared.vlm import Prefill
from probe_kit.models.checkpoint_files import LANGUAGE_FIRST, SIGLIP_TOWER, picture_values, rename_tensor
from tests.support import saved_again
from tests.support.every_checkpoint import WRITERS, families
from tests.support.saved_again import CLASSES, LAYOUTS, copied, join_processor, rename_weights
from tests.support.slow_cases import slow_but
from tests.support.vlm_checkpoints import write_paligemma

PICTURE = np.random.default_rng(0).integers(0, 255, (60, 60, 3)).astype(np.uint8)
SEEN = Observation(
    PICTURE,
    np.zeros(8, np.float32),
    "red",
    intrinsics=np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1]], np.float32),
)
QUESTION = Prompt(SEEN, "Do you see red?")
LONGEST = ("paligemma", "5.24, from a configuration")
NEWEST = ("transformers==5.24.0", "tokenizers==0.23.3")


FURTHER_OPTIONS = {"pi0": {"statistics": "bridge"}}


def outputs(family: str, folder: Path) -> NDArray[Any]:
    """The logits of a question, or the actions of one inference."""
    model = load_model(family, str(folder), **WRITERS[family][1], **FURTHER_OPTIONS.get(family, {}))
    if hasattr(model, "prefill"):
        return np.asarray(model.prefill([QUESTION]).logits.float())
    state = np.zeros(model.state_numbers or len(SEEN.state), np.float32)
    return np.asarray(model.predict([replace(SEEN, state=state)], [3]))


def written(family: str, tmp_path: Path) -> Path:
    return WRITERS[family][0](tmp_path / "released")


@pytest.mark.parametrize(
    ("family", "layout"),
    [
        pytest.param(
            family, layout, marks=[pytest.mark.slow] * ((family, layout) not in [("internvl", "5.5"), LONGEST])
        )
        for family, layouts in LAYOUTS.items()
        for layout in layouts
    ],
)
def test_every_naming_of_weights_gives_the_same_answers(family: str, layout: str, tmp_path: Path) -> None:
    source = written(family, tmp_path)
    folder = copied(source, tmp_path / "again")
    rename_weights(folder, LAYOUTS[family][layout])
    join_processor(folder)
    np.testing.assert_array_equal(outputs(family, folder), outputs(family, source))


def test_names_of_a_module_stay_as_they_are() -> None:
    for name in (
        "model.language_model.layers.0.self_attn.q_proj.weight",
        "lm_head.weight",
        "model.vision_tower.vision_model.encoder.layers.1.mlp.fc1.bias",
        "model.multi_modal_projector.linear.weight",
    ):
        assert rename_tensor(name, (*LANGUAGE_FIRST, *SIGLIP_TOWER)) == name


def test_a_tensor_that_another_naming_lacks_is_still_missed_by_name(tmp_path: Path) -> None:
    folder = copied(written("paligemma", tmp_path), tmp_path / "again")
    rename_weights(folder, LAYOUTS["paligemma"]["5.24, from a configuration"])
    tensors = load_file(folder / "model.safetensors")
    del tensors["vision_tower.post_layernorm.bias"]
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(
        WeightsError, match=r"1 tensors missing: model\.vision_tower\.vision_model\.post_layernorm\.b"
    ):
        load_model("paligemma", str(folder))


@pytest.mark.parametrize("change", [0.0, 1.0])
def test_one_tensor_under_two_names_counts_once_if_both_are_equal_and_is_refused_otherwise(
    change: float, tmp_path: Path
) -> None:
    folder = copied(written("paligemma", tmp_path), tmp_path / "again")
    tensors = load_file(folder / "model.safetensors")
    name = "language_model.model.norm.weight"
    tensors[f"model.{name}"] = tensors[name] + change
    save_file(tensors, folder / "model.safetensors")
    if not change:
        load_model("paligemma", str(folder))
        return
    with pytest.raises(
        WeightsError, match=r"language_model\.model\.norm\.weight and model\.language_model\.model\.no"
    ):
        load_model("paligemma", str(folder))


# -- processors -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "first", ["processor_config.json", pytest.param("preprocessor_config.json", marks=pytest.mark.slow)]
)
def test_where_two_files_have_pictures_the_one_counts_that_transformers_reads(first: str, tmp_path: Path) -> None:
    """The reader of transformers is the oracle; the card says what the other file has."""
    folder = copied(written("qwen3-vl", tmp_path), tmp_path / "both")
    other = copied(folder, tmp_path / "other") / "preprocessor_config.json"
    values = json.loads(other.read_text(encoding="utf-8"))
    changed = {**values, "image_mean": [0.25, 0.5, 0.75]}
    used, unused = (changed, values) if first == "processor_config.json" else (values, changed)
    (folder / "processor_config.json").write_text(json.dumps({"image_processor": used}), encoding="utf-8")
    (folder / "preprocessor_config.json").write_text(json.dumps(unused), encoding="utf-8")

    model = load_model("qwen3-vl", str(folder))

    expected = Qwen2VLImageProcessor.from_pretrained(str(folder)).image_mean
    assert model.pictures.settings["image_mean"] == list(expected) == used["image_mean"]
    assert any("preprocessor_config.json beside it has another image_mean" in note for note in model.card.notes)


def test_equal_settings_in_two_files_are_no_conflict(tmp_path: Path) -> None:
    folder = copied(written("paligemma", tmp_path), tmp_path / "both")
    values = json.loads((folder / "preprocessor_config.json").read_text(encoding="utf-8"))
    settings = {"image_processor": {**values, "image_processor_type": "SiglipImageProcessor"}}
    (folder / "processor_config.json").write_text(json.dumps(settings), encoding="utf-8")
    assert not any("pictures" in note for note in load_model("paligemma", str(folder)).card.notes)


@pytest.mark.parametrize("family", slow_but(("paligemma",), ["paligemma", "internvl", "qwen2.5-vl", "ovis2.5"]))
def test_without_any_settings_of_pictures_both_files_are_named_and_no_copy_is_advised(
    family: str, tmp_path: Path
) -> None:
    folder = copied(written(family, tmp_path), tmp_path / "lacking")
    (folder / "preprocessor_config.json").unlink()
    (folder / "processor_config.json").write_text('{"processor_class": "Any"}', encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"preprocessor_config\.json is missing.*image_processor") as caught:
        load_model(family, str(folder)).prefill([QUESTION])
    assert "Copy it" not in str(caught.value)


ADAPTERS = {
    "one file over one file": (True, True),
    "one file over the older two": (True, False),
    "the older file over one file": (False, True),
}


@pytest.mark.parametrize("kind", list(ADAPTERS))
def test_the_pictures_of_an_adapter_count_before_its_bases_in_whichever_file_they_are(
    kind: str, tmp_path: Path
) -> None:
    adapters, bases = ADAPTERS[kind]
    base, alone = copied(written("paligemma", tmp_path), tmp_path / "base"), tmp_path / "alone"
    alone.mkdir()
    values = json.loads((base / "preprocessor_config.json").read_text(encoding="utf-8"))
    changed = {**values, "image_mean": [0.25, 0.5, 0.75]}
    (alone / "preprocessor_config.json").write_text(json.dumps(changed), encoding="utf-8")
    for folder, joined in ((alone, adapters), (base, bases)):
        if joined:
            join_processor(folder)
    settings = {"peft_type": "LORA", "r": 2, "base_model_name_or_path": str(base)}
    (alone / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    stored = picture_values(checkpoint_folder(str(alone)))
    assert stored is not None
    assert stored.values["image_mean"] == changed["image_mean"]


def test_words_that_a_processor_added_beyond_the_vocabulary_are_refused_where_a_text_has_one(
    tmp_path: Path,
) -> None:
    """PaliGemma's processor adds 1,152 words to a tokenizer without them, and the network is saved as it was."""
    from tokenizers import Tokenizer

    folder = copied(written("paligemma", tmp_path), tmp_path / "added")
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    tokenizer.add_tokens([f"<loc{number:04}>" for number in range(100)])
    tokenizer.save(str(folder / "tokenizer.json"))
    model = load_model("paligemma", str(folder))
    expected = outputs("paligemma", tmp_path / "released")
    np.testing.assert_array_equal(model.prefill([QUESTION]).logits.numpy(), expected)
    with pytest.raises(InstructionError, match="'<loc0099>', which was added to the tokenizer"):
        model.prefill([replace(QUESTION, text="detect <loc0099>")])


# -- configurations -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", slow_but(("qwen3-vl",), ["qwen2.5-vl", "qwen3-vl"]))
@pytest.mark.parametrize("theta", [10000.0, 500.0])
def test_frequencies_of_a_vision_tower_that_the_installed_network_cannot_have_are_refused(
    family: str, theta: float, tmp_path: Path
) -> None:
    folder = copied(written(family, tmp_path), tmp_path / "again")
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    values["vision_config"] |= {"model_type": f"{values['model_type']}_vision"}
    values["vision_config"]["rope_parameters"] = {"rope_theta": theta, "rope_type": "axial"}
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    if theta == 10000.0:
        load_model(family, str(folder))
        return
    with pytest.raises(CheckpointError, match=r"rope_theta 500\.0 in vision_config\.rope_parameters"):
        load_model(family, str(folder))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
@pytest.mark.parametrize("family", families())
def test_every_family_reads_the_newest_layout_of_names_and_settings(family: str, tmp_path: Path) -> None:
    """Tower names, `rope_parameters`, `dtype`, one file of a processor, a tokenizer's shorter settings."""
    source = written(family, tmp_path)
    root = source if family != "internvla-m1" else source.parent
    again = copied(root, tmp_path / "again")
    saved_again.write_in_newest_layout(again)
    folder = again / source.relative_to(root)
    np.testing.assert_array_equal(outputs(family, folder), outputs(family, source))


# -- adapters -------------------------------------------------------------------------------------------------


def tuned_paligemma(base: Path, **settings: Any) -> Any:
    """A PaliGemma with random factors, which is tied in its files."""
    from transformers import PaliGemmaForConditionalGeneration

    network = PaliGemmaForConditionalGeneration.from_pretrained(base)
    tuned = get_peft_model(network, LoraConfig(r=2, lora_alpha=4, **settings))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in tuned.named_parameters():
            if "lora_" in name or "modules_to_save" in name:
                value.add_(0.05 * torch.randn(value.shape, generator=generator))
    return tuned


def save_adapter(tuned: Any, folder: Path, base: Path) -> Path:
    tuned.save_pretrained(folder)
    settings = json.loads((folder / "adapter_config.json").read_text(encoding="utf-8"))
    settings["base_model_name_or_path"] = str(base)
    (folder / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    return folder


def peft_logits(model: Any, network: Any) -> NDArray[Any]:
    """The logits of what peft loaded, for the question as the adapter's own model packs it."""
    packed, pictures = model.packed([model.prompt(QUESTION)]), model.picture_inputs([PICTURE])
    other_inputs = {**pictures, **model.other_inputs(packed)}
    with torch.inference_mode():
        return Prefill.of(network.eval(), packed, model.positions(packed, pictures), other_inputs).logits.numpy()


EMBEDDINGS: dict[str, Mapping[str, Any]] = {
    "embedding": {"target_modules": ["q_proj", "embed_tokens"]},
    "embedding, DoRA": {"target_modules": ["q_proj", "embed_tokens"], "use_dora": True},
    "both, tied": {"target_modules": ["q_proj", "embed_tokens"], "ensure_weight_tying": True},
    "both": {"target_modules": ["embed_tokens", "lm_head"]},
    "head": {"target_modules": ["lm_head"]},
    "embedding trained whole": {"target_modules": ["q_proj"], "modules_to_save": ["embed_tokens"]},
    "head trained whole": {"target_modules": ["q_proj"], "modules_to_save": ["lm_head"]},
    "both trained whole": {"target_modules": ["q_proj"], "modules_to_save": ["embed_tokens", "lm_head"]},
    "biases": {"target_modules": ["q_proj", "fc1"], "bias": "all"},
    "some layers": {
        "target_modules": ["q_proj", "v_proj"], "layers_to_transform": [1], "layers_pattern": "layers",
        "rank_pattern": {r"layers\.1\..*q_proj": 3}, "alpha_pattern": {"v_proj": 7}, "use_rslora": True,
    },
}  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "embedding")) for kind in EMBEDDINGS]
)
def test_an_adapter_of_tied_embeddings_answers_as_peft_does_without_merging(kind: str, tmp_path: Path) -> None:
    """peft's own merge adds the factors of one layer to the other too, because both are one tensor there."""
    from transformers import PaliGemmaForConditionalGeneration

    base = written("paligemma", tmp_path)
    folder = save_adapter(tuned_paligemma(base, **EMBEDDINGS[kind]), tmp_path / "tuned", base)
    model = load_model("paligemma", str(folder))
    loaded = PeftModel.from_pretrained(PaliGemmaForConditionalGeneration.from_pretrained(base), folder)
    logits = model.prefill([QUESTION]).logits.numpy()
    np.testing.assert_allclose(logits, peft_logits(model, loaded), atol=2e-5)
    assert np.abs(logits - outputs("paligemma", base)).max() > 0.01
    assert ("no longer tied" in model.card.audit["adapter"]) == (
        kind not in ("both, tied", "biases", "some layers")
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_embedding_of_another_base_beside_the_factors_replaces_the_bases_and_is_said(tmp_path: Path) -> None:
    from transformers import PaliGemmaForConditionalGeneration

    base = written("paligemma", tmp_path)
    folder = save_adapter(tuned_paligemma(base, **EMBEDDINGS["embedding"]), tmp_path / "tuned", base)
    file = folder / "adapter_model.safetensors"
    tensors = load_file(file)
    (name,) = [name for name in tensors if name.endswith("embed_tokens.base_layer.weight")]
    save_file({**tensors, name: tensors[name] + 0.5}, file)

    model = load_model("paligemma", str(folder))

    loaded = PeftModel.from_pretrained(PaliGemmaForConditionalGeneration.from_pretrained(base), folder)
    np.testing.assert_allclose(model.prefill([QUESTION]).logits.numpy(), peft_logits(model, loaded), atol=2e-5)
    assert (
        "embed_tokens.weight replaces the base's, from which it differs by up to 0.5"
        in model.card.audit["adapter"]
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"target_modules": ["q_proj"], "lora_bias": True}, "cannot be merged at .*q_proj"),
        ({"target_modules": ["q_proj"], "trainable_token_indices": [3, 4]}, "trainable_token_indices"),
        ({"target_modules": [], "target_parameters": ["q_proj.weight"]}, "target_parameters"),
    ],
)
def test_an_adapter_that_no_merge_can_hold_is_refused_by_name(
    settings: dict[str, Any], complaint: str, tmp_path: Path
) -> None:
    base = written("paligemma", tmp_path)
    folder = save_adapter(tuned_paligemma(base, **settings), tmp_path / "tuned", base)
    with pytest.raises((CheckpointError, WeightsError), match=complaint):
        load_model("paligemma", str(folder))


# -- saved by transformers itself -----------------------------------------------------------------------------

PARTS = {"smolvla": "vlm", "groot": "base/vlm", "eo1": "vlm", "internvla-m1": "../vlm"}
"""The folders of files of transformers inside or beside the tiny checkpoints of policies."""
VERSIONS = ("installed", "newest")


@pytest.fixture(scope="module")
def newest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the newest transformers, for the front of the path; everything else is this environment's."""
    folder = tmp_path_factory.mktemp("newest")
    uv = shutil.which("uv") or next(map(str, Path(__file__).parents[2].glob(".uv/bin/uv")), None)
    pip = [uv, "pip", "install", "--python", sys.executable] if uv else [sys.executable, "-m", "pip", "install"]
    completed = subprocess.run(
        [*pip, "--no-deps", "--target", str(folder), *NEWEST],
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )
    if completed.returncode:
        reason = (completed.stderr.strip().splitlines() or ["no message"])[-1]
        pytest.skip(f"{' and '.join(NEWEST)} cannot be installed: {reason}")
    return folder


@pytest.fixture(scope="module", params=VERSIONS)
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A version of transformers, and a folder with what it saved of every family, by one process."""
    version, root = str(request.param), tmp_path_factory.mktemp("saved")
    jobs: list[tuple[str, ...]] = []
    for family in CLASSES:
        source, out = str(_released(family, root / family / "released")), str(root / family)
        jobs += [("whole", family, source, f"{out}/{origin}", origin) for origin in ("loaded", "configured")]
        jobs += [("lora", family, source, f"{out}/lora")]
    for family, part in PARTS.items():
        checkpoint = WRITERS[family][0](root / family)
        np.save(root / f"{family}.npy", outputs(family, checkpoint))
        jobs.append(("parts", str((checkpoint / part).resolve())))
    _run(jobs, None if version == "installed" else request.getfixturevalue("newest"), root)
    return version, root


def _released(family: str, folder: Path) -> Path:
    if family != "paligemma":
        return WRITERS[family][0](folder)
    return write_paligemma(folder, vocabulary=1536)  # its processor adds 1,152 tokens of places in pictures


def _run(jobs: list[tuple[str, ...]], transformers: Path | None, root: Path) -> None:
    file = root / "jobs.json"
    file.write_text(json.dumps(jobs), encoding="utf-8")
    path = {} if transformers is None else {"PYTHONPATH": str(transformers)}
    completed = subprocess.run(
        [sys.executable, saved_again.__file__, str(file)],
        env={**os.environ, "HF_HUB_OFFLINE": "1", "TRANSFORMERS_VERBOSITY": "error", **path},
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )
    assert completed.returncode == 0, completed.stderr[-3000:]


def names_in(folder: Path) -> set[str]:
    with safe_open(folder / "model.safetensors", "pt") as file:
        return set(file.keys())


def naming_of(family: str, origin: str, version: str) -> str:
    if version == "installed":
        return "5.5"
    return "5.24, from a configuration" if (family, origin) == ("paligemma", "configured") else "released"


@pytest.mark.slow
@pytest.mark.parametrize("origin", ["loaded", "configured"])
@pytest.mark.parametrize("family", list(CLASSES))
def test_what_transformers_saved_again_gives_the_same_answers(
    family: str, origin: str, saved: tuple[str, Path], tmp_path: Path
) -> None:
    version, root = saved
    folder = root / family / origin
    assert not (folder / "preprocessor_config.json").exists()
    np.testing.assert_array_equal(outputs(family, folder), outputs(family, root / family / "released"))
    if family in LAYOUTS:
        like = copied(root / family / "released", tmp_path / "like")
        rename_weights(like, LAYOUTS[family][naming_of(family, origin, version)])
        assert names_in(folder) == names_in(like)


@pytest.mark.slow
@pytest.mark.parametrize("family", list(CLASSES))
def test_an_adapter_and_its_merge_by_peft_give_the_same_answers(family: str, saved: tuple[str, Path]) -> None:
    folder = saved[1] / family
    adapter_outputs = outputs(family, folder / "lora")
    np.testing.assert_array_equal(adapter_outputs, outputs(family, folder / "lora-merged"))
    assert np.abs(adapter_outputs - outputs(family, folder / "released")).max() > 0.001


@pytest.mark.slow
@pytest.mark.parametrize("family", list(PARTS))
def test_policies_read_a_vision_language_model_that_transformers_saved_again(
    family: str, saved: tuple[str, Path]
) -> None:
    root = saved[1]
    folder = root / family / "run" if family == "internvla-m1" else root / family
    np.testing.assert_array_equal(outputs(family, folder), np.load(root / f"{family}.npy"))


@pytest.mark.slow
@pytest.mark.parametrize("family", list(CLASSES))
def test_what_the_installed_and_then_the_newest_transformers_saved_gives_the_same_answers(
    family: str, newest: Path, tmp_path: Path
) -> None:
    source, first, second = (
        _released(family, tmp_path / "released"),
        str(tmp_path / "first"),
        str(tmp_path / "second"),
    )
    _run([("whole", family, str(source), first, "loaded")], None, tmp_path)
    _run([("whole", family, first, second, "loaded")], newest, tmp_path)
    np.testing.assert_array_equal(outputs(family, tmp_path / "second"), outputs(family, source))
