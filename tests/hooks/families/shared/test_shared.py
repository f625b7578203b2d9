"""Recomputed attention weights equal those of the inference: weights times values give its output."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file
from torch.nn import functional
from transformers import DynamicCache, LlamaConfig, LlamaModel
from transformers.generation.logits_process import TemperatureLogitsWarper, TopKLogitsWarper

from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    UnsupportedInterventionError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks import Prompt, load_model
from probe_kit.hooks.families.shared.taps import (
    on_the_prompt,
    recompute_weights,
    recording_weights,
    returned_weights,
    shares,
)
from probe_kit.hooks.families.shared.text import FramedText, QuestionFrame
from probe_kit.hooks.families.shared.token_decoder import ALL, CHECKPOINT, TOP, chooser, top_of
from probe_kit.hooks.families.xiaomi.network import Attention
from probe_kit.hooks.registry import find_family
from probe_kit.hooks.testing import example_observations
from tests.support.qwen_checkpoints import ID, write_tokenizer
from tests.support.vlm_checkpoints import (
    write_internvl,
    write_ovis2_5,
    write_paligemma,
    write_qwen2_5_vl,
    write_qwen3_vl,
)


def test_shares_are_those_of_torchs_own_attention_under_either_kind_of_mask() -> None:
    torch.manual_seed(0)
    queries, keys, values = (torch.randn(2, heads, tokens, 8) for heads, tokens in ((4, 3), (2, 5), (2, 5)))
    allowed = torch.rand(2, 1, 3, 5) > 0.3
    allowed[..., 0] = True
    every = values.repeat_interleave(2, dim=1)
    expected = functional.scaled_dot_product_attention(
        queries, keys.repeat_interleave(2, dim=1), every, attn_mask=allowed, scale=0.5
    )
    added = torch.zeros(2, 1, 3, 5).masked_fill(~allowed, torch.finfo(torch.float32).min)
    for mask in (allowed, added):
        torch.testing.assert_close(shares(queries, keys, 0.5, {"attention_mask": mask}) @ every, expected)


def test_llamas_last_position_is_weighed_as_eager_attention_weighs_it() -> None:
    """Over the prompt and over every token behind it, with fewer heads for keys than for queries."""
    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=11, hidden_size=32, intermediate_size=16, num_hidden_layers=2, num_attention_heads=4,
        num_key_value_heads=2, max_position_embeddings=32,
    )  # fmt: skip
    config._attn_implementation = "eager"
    network, cache = LlamaModel(config).eval(), DynamicCache(config=config)
    attentions = [layer.self_attn for layer in network.layers]
    recorded: dict[str, dict[tuple[int, int], torch.Tensor]] = {"returned": {}, "recomputed": {}}

    def noting(name: str):
        return on_the_prompt(lambda block, iteration, mass: recorded[name].update({(block, iteration): mass}))

    with (
        torch.inference_mode(),
        recording_weights(attentions, noting("returned"), returned_weights),
        recording_weights(attentions, noting("recomputed"), recompute_weights),
    ):
        for ids in ([[1, 2, 3, 4, 5, 6]], [[7]], [[8]]):
            network(input_ids=torch.tensor(ids), past_key_values=cache, use_cache=True)
    assert recorded["returned"].keys() == {(block, iteration) for block in (0, 1) for iteration in (0, 1, 2)}
    for read, weights in recorded["returned"].items():
        assert weights.shape == (1, 4, 1, 5)  # the prompt without its last token
        torch.testing.assert_close(recorded["recomputed"][read], weights)


def test_xiaomis_weights_on_its_values_are_what_its_attention_reads() -> None:
    torch.manual_seed(0)
    attention = Attention(32, 8, 2).eval()
    stream, cache = torch.randn(2, 4, 32), (torch.randn(2, 2, 5, 8), torch.randn(2, 2, 5, 8))
    rotation = (torch.randn(2, 4, 8), torch.randn(2, 4, 8))
    mask = torch.ones(2, 1, 4, 9, dtype=torch.bool)
    mask[1, :, :, :2] = False
    with torch.inference_mode():
        read = attention(stream, cache, rotation, mask)
        weights = attention.weights(stream, cache, rotation, mask)
        values = attention._parts(stream, cache, rotation)[2]
        again = attention.o_proj((weights @ values).transpose(1, 2).flatten(2))
    torch.testing.assert_close(again, read)
    assert (weights[1, :, :, :2] == 0).all()


@pytest.mark.parametrize("network", ["Qwen3", "Gemma2"])
def test_an_attention_with_a_norm_of_queries_or_a_soft_cap_is_refused_not_recomputed_wrongly(network: str) -> None:
    config = getattr(transformers, f"{network}Config")(
        vocab_size=11, hidden_size=32, intermediate_size=16, num_hidden_layers=1, num_attention_heads=4,
        num_key_value_heads=2, head_dim=8,
    )  # fmt: skip
    attention = getattr(transformers, f"{network}Model")(config).layers[0].self_attn
    step = {"Qwen3": "q_norm", "Gemma2": "attn_logit_softcapping"}[network]
    with pytest.raises(UnsupportedInterventionError, match=rf"{network}Attention .*{step}.*Patch `kv`"):
        recompute_weights(attention, (torch.zeros(1, 1, 32),), {}, None)


def test_an_attention_of_another_kind_is_refused() -> None:
    with pytest.raises(UnsupportedInterventionError, match="Patch `kv`"):
        recompute_weights(torch.nn.Identity(), (), {}, None)


def logits(rows: int) -> torch.Tensor:
    return torch.randn((rows, 400), generator=torch.Generator().manual_seed(0)) * 3


def test_without_temperature_the_likeliest_is_chosen() -> None:
    assert torch.equal(chooser(0, [1, 2])(logits(2)), logits(2).argmax(dim=1))


def test_draws_come_from_a_rows_own_seed_whatever_stands_beside_it() -> None:
    torch.manual_seed(1)
    row = logits(2)[1:]
    together = [chooser(0.7, [3, 4])(logits(2))[1] for _ in range(2)]
    assert together[0] == together[1] == chooser(0.7, [4])(row)[0]
    draw = chooser(0.7, [4])
    assert len({int(draw(row)[0]) for _ in range(20)}) > 1


@pytest.mark.slow
def test_draws_follow_the_distribution_among_the_likeliest() -> None:
    row = logits(1)
    draw = chooser(0.7, [5])
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    best = row[0].topk(TOP).indices
    assert int(counts.sum()) == int(counts[best].sum())
    expected = torch.softmax(row[0][best] / 0.7, dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts[best] / 4000 - expected).abs() < 5 * spread + 1e-9).all()


def test_draws_among_some_ids_only_never_leave_them_and_follow_their_distribution() -> None:
    row, among = logits(1), range(300, 316)
    draw = chooser(0.6, [6], top=None, among=among)
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    assert int(counts[300:316].sum()) == 4000
    expected = torch.softmax(row[0, 300:316] / 0.6, dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts[300:316] / 4000 - expected).abs() < 5 * spread + 1e-9).all()


@pytest.mark.parametrize("temperature", [-0.1, float("inf"), float("nan")])
def test_a_meaningless_temperature_is_refused(temperature: float) -> None:
    with pytest.raises(UsageError, match="temperature"):
        chooser(temperature, [])


@pytest.mark.slow
@pytest.mark.parametrize("top", [1, 5, 50])
def test_what_can_be_drawn_is_what_transformers_keeps_ties_of_the_last_one_included(top: int) -> None:
    """In bfloat16 many ids are as likely as the last of the kept ones."""
    row, among = logits(1).bfloat16(), range(100, 356)
    masked = torch.full_like(row, -torch.inf)
    masked[:, among.start : among.stop] = row[:, among.start : among.stop]
    ids = torch.zeros((1, 1), dtype=torch.long)
    theirs = TopKLogitsWarper(top)(ids, TemperatureLogitsWarper(0.6)(ids, masked.float()))
    allowed = set(torch.isfinite(theirs[0]).nonzero().flatten().tolist())
    draw = chooser(0.6, [1], top, among)
    counts = torch.bincount(torch.cat([draw(row) for _ in range(4000)]), minlength=400)
    assert set(counts.nonzero().flatten().tolist()) <= allowed
    expected = torch.softmax(theirs[0], dim=0)
    spread = (expected * (1 - expected) / 4000).sqrt()
    assert ((counts / 4000 - expected).abs() < 5 * spread + 1e-9).all()


def test_ties_with_the_last_of_the_kept_ones_are_kept() -> None:
    row = torch.tensor([[2.0, 1.0, 1.0, 0.0]])
    draw = chooser(1.0, [1], 2)
    assert {int(draw(row)[0]) for _ in range(200)} == {0, 1, 2}


def test_how_many_are_kept_is_the_checkpoints_word_or_the_librarys_default(tmp_path: Path) -> None:
    assert (top_of(ALL, [tmp_path]), top_of("7", [tmp_path]), top_of(CHECKPOINT, [tmp_path])) == (None, 7, TOP)
    file = tmp_path / "generation_config.json"
    stored = {"bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 32000, "transformers_version": "4.40.1"}
    for generation_settings, expected in (
        ({}, TOP),
        ({"top_k": 20}, 20),
        ({"top_k": 0}, None),
        ({"top_p": 1.0}, TOP),
    ):
        file.write_text(json.dumps(stored | generation_settings), encoding="utf-8")
        assert top_of(CHECKPOINT, [tmp_path / "adapter", tmp_path]) == expected


@pytest.mark.parametrize(
    "generation_settings", [{"top_p": 0.9}, {"repetition_penalty": 1.2}, {"top_k": "many"}, {"top_k": -1}]
)
def test_a_draw_that_is_shaped_otherwise_is_refused(
    tmp_path: Path, generation_settings: dict[str, object]
) -> None:
    (tmp_path / "generation_config.json").write_text(json.dumps(generation_settings), encoding="utf-8")
    with pytest.raises(CheckpointError, match=next(iter(generation_settings))):
        top_of(CHECKPOINT, [tmp_path])
    with pytest.raises(UsageError, match="expected a number from 1 on, all or checkpoint"):
        top_of("0", [tmp_path])


def test_files_under_the_names_of_todays_transformers_load_too(tmp_path: Path) -> None:
    folder = write_qwen2_5_vl(tmp_path)
    before = load_model("qwen2.5-vl", str(folder))
    save_file(
        {name: tensor.clone() for name, tensor in before.network.state_dict().items()},
        folder / "model.safetensors",
    )
    after = load_model("qwen2.5-vl", str(folder))
    state, other = before.network.state_dict(), after.network.state_dict()
    assert all(torch.equal(state[name], other[name]) for name in state)


@pytest.mark.slow
def test_nothing_stays_on_the_meta_device(tmp_path: Path) -> None:
    for family, write in (
        ("qwen2.5-vl", write_qwen2_5_vl), ("qwen3-vl", write_qwen3_vl), ("internvl", write_internvl),
        ("paligemma", write_paligemma), ("ovis2.5", write_ovis2_5),
    ):  # fmt: skip
        network = load_model(family, str(write(tmp_path / family)), dtype="bfloat16").network
        assert not any(tensor.is_meta for tensor in (*network.parameters(), *network.buffers()))
        frequencies = [tensor for name, tensor in network.named_buffers() if "inv_freq" in name]
        assert frequencies
        assert {tensor.dtype for tensor in frequencies} == {torch.float32}


def test_the_larger_internvl_has_another_tower(tmp_path: Path) -> None:
    vlm = load_model("internvl", str(write_internvl(tmp_path, large=True)))
    names = {name.rpartition("encoder.layer.0.")[2] for name in vlm.network.state_dict()}
    assert "attention.q_norm.weight" in names
    assert "attention.q_proj.bias" not in names
    observation = example_observations(["Why?"])[0]
    reading = vlm.read([Prompt(observation, "Why?", ("A", "B"))])
    other = vlm.read([Prompt(replace(observation, image=255 - observation.image), "Why?", ("A", "B"))])
    assert np.abs(reading.option_logits - other.option_logits).max() > 0


def test_a_tied_tensor_that_the_file_holds_twice_must_be_equal(tmp_path: Path) -> None:
    folder = write_qwen3_vl(tmp_path, tied=True)
    tensors = load_file(folder / "model.safetensors")
    assert "lm_head.weight" not in tensors
    tensors["lm_head.weight"] = tensors["model.language_model.embed_tokens.weight"].clone()
    save_file(tensors, folder / "model.safetensors")
    load_model("qwen3-vl", str(folder))
    tensors["lm_head.weight"][0, 0] += 1
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(WeightsError, match="ties it"):
        load_model("qwen3-vl", str(folder))


def test_untied_output_weights_may_not_be_missing(tmp_path: Path) -> None:
    folder = write_qwen2_5_vl(tmp_path)
    tensors = load_file(folder / "model.safetensors")
    del tensors["lm_head.weight"]
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(WeightsError, match=r"lm_head\.weight"):
        load_model("qwen2.5-vl", str(folder))


def test_the_layout_of_internvls_own_code_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "internvl_chat"}), encoding="utf-8")
    with pytest.raises(CheckpointError, match="-HF"):
        load_model("internvl", str(tmp_path))


def test_a_configuration_that_describes_no_network_is_refused(tmp_path: Path) -> None:
    folder = write_paligemma(tmp_path)
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    for damaged in (
        {**values, "text_config": 3},
        {**values, "vision_config": {**values["vision_config"], "patch_size": 0}},
    ):
        (folder / "config.json").write_text(json.dumps(damaged), encoding="utf-8")
        with pytest.raises(CheckpointError, match="describes no network"):
            load_model("paligemma", str(folder))


def test_a_size_stands_for_a_checkpoint(tmp_path: Path) -> None:
    family = find_family("qwen3-vl")
    assert family.location(None, "4B") == "Qwen/Qwen3-VL-4B-Instruct"
    assert family.location(None) == family.default_checkpoint == "Qwen/Qwen3-VL-8B-Instruct"
    with pytest.raises(UsageError, match="leave one of them out"):
        load_model("qwen3-vl", str(write_qwen3_vl(tmp_path)), size="4B")
    with pytest.raises(UsageError, match="expected one of 8B, 32B, 4B"):
        load_model("qwen3-vl", size="5B")


def test_two_pictures_of_different_size_go_together(tmp_path: Path) -> None:
    """Positions come from each row's own mask and picture."""
    vlm = load_model("qwen3-vl", str(write_qwen3_vl(tmp_path)))
    small, large = example_observations(["Why?", "Why not?"])
    large = replace(large, image=np.tile(large.image, (3, 2, 1)))
    prompts = [Prompt(observation, observation.instruction, ("A", "B")) for observation in (small, large)]
    together = vlm.read(prompts)
    alone = [vlm.read([question]).option_logits[0] for question in prompts]
    np.testing.assert_allclose(together.option_logits, alone, atol=1e-5)
    assert vlm.speak(together, 5) == [vlm.speak(vlm.read([question]), 5)[0] for question in prompts]


@pytest.mark.parametrize(
    "vision", [{"fullatt_block_indexes": [1]}, {"use_rope": False}, {"hidden_act": "gelu"}, {"hidden_size": 36}]
)
def test_towers_that_no_released_ovis_has_are_refused(vision: dict[str, object], tmp_path: Path) -> None:
    folder = write_ovis2_5(tmp_path)
    values = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    values["vit_config"] |= vision
    (folder / "config.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(CheckpointError, match="vit_config"):
        load_model("ovis2.5", str(folder))


FRAME = QuestionFrame(
    "<|im_start|>user\n<|vision_start|>", "<|vision_end|>", "<|im_start|>user\n", "<|im_end|>\nSay: "
)
PAD = ID["<|image_pad|>"]


def _text(folder: Path, vocabulary: int = 272, end: object = ID["<|im_end|>"]) -> FramedText:
    write_tokenizer(folder)
    return FramedText.of(folder, FRAME, SimpleNamespace(vocab_size=vocabulary, eos_token_id=end), folder)


def test_the_question_stands_between_picture_and_end(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why not?", "Yes", [PAD] * 5)
    question_positions = [index for index, is_question in enumerate(prompt.question) if is_question]
    assert len(question_positions) == len("Why not?")
    assert prompt.ids[slice(*prompt.picture)] == (PAD,) * 5
    assert prompt.ids[prompt.picture[1]] == ID["<|vision_end|>"]
    assert question_positions[0] == prompt.picture[1] + 1
    assert len(prompt.ids) - 1 - question_positions[-1] == 1 + len("\nSay: ") + len("Yes")


def test_without_a_picture_nothing_marks_its_place(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why?")
    assert prompt.picture == (0, 0)
    assert ID["<|vision_start|>"] not in prompt.ids
    assert ID["<|vision_end|>"] not in prompt.ids


def test_marks_at_the_ends_of_a_picture_are_no_picture(tmp_path: Path) -> None:
    prompt = _text(tmp_path).prompt("Why?", picture=[-1, -9, -9, -2], marks=1)
    assert prompt.ids[slice(*prompt.picture)] == (-9, -9)


@pytest.mark.parametrize("token", ["<|im_end|>", "<|image_pad|>"])
def test_a_question_that_holds_a_token_of_the_frames_is_refused(token: str, tmp_path: Path) -> None:
    text = _text(tmp_path)
    with pytest.raises(InstructionError, match="stands for something else"):
        text.prompt(f"Do you see {token}?")
    with pytest.raises(InstructionError, match="stands for something else"):
        text.prompt("Why?", begun=token)


def test_an_option_is_the_token_behind_the_prompt(tmp_path: Path) -> None:
    text = _text(tmp_path)
    prompt = text.prompt("Why?")
    assert text.option(prompt, "A") == text.prompt("Why?", "A").ids[-1]
    assert text.option(prompt, "Apple") == text.option(prompt, "A")
    with pytest.raises(UsageError, match="merges with"):
        text.option(prompt, "")


def test_what_is_said_ends_at_an_end(tmp_path: Path) -> None:
    (tmp_path / "generation_config.json").write_text(
        json.dumps({"eos_token_id": [ID["<|endoftext|>"], 0]}), encoding="utf-8"
    )
    text = _text(tmp_path)
    left_ids = list(text.prompt("", "left").ids[-4:])
    assert text.decode([*left_ids, ID["<|endoftext|>"], *left_ids]) == "left"
    assert text.decode([ID["<|im_start|>"], *left_ids]) == "left"


def test_another_models_tokenizer_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="ids up to 262; this model has 260"):
        _text(tmp_path, 260)
    with pytest.raises(CheckpointError, match=r"config\.json says 7"):
        _text(tmp_path).check_token("<|image_pad|>", 7)


def test_files_that_are_missing_are_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"tokenizer\.json is missing"):
        FramedText.of(tmp_path, FRAME, SimpleNamespace(vocab_size=272, eos_token_id=1), tmp_path)
    with pytest.raises(CheckpointError, match="eos_token_id"):
        _text(tmp_path, end=None)
