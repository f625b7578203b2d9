"""The words of the embedded models: listed, and checked before a model is loaded."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors import safe_open
from safetensors.torch import load_file
from transformers import PaliGemmaForConditionalGeneration
from transformers.models.paligemma.modeling_paligemma import create_causal_mask_mapping
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.env import SceneSpec
from probe_kit.errors import InstructionError
from probe_kit.extract import AskSettings, ExtractSettings, ask_run, extract_run
from probe_kit.extract.extraction import open_checked
from probe_kit.extract.prompts import ORDERS, TEMPLATES, Phrase
from probe_kit.extract.protocols import scene_of
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.embedded import ACTION_DIMS
from probe_kit.hooks.families.paligemma.adapter import PaliGemma, load_vlm_tiny
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.registry import find_family, own_families
from probe_kit.models.decoding import LeftPacked
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.models.embedded.words import SPECIAL, WORDS, known_words, words_in
from probe_kit.suite import Terms, build_suite, suite_from_csv
from probe_kit.suite.generators import GENERATORS, vocabulary

EMBEDDED = ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state", "vlm-tiny")
TEXTS = (
    "Put the cube on the red square",
    "Put the cube on the clock that says 7:30, not 8:15.",
    'Choices: "a" or "b"?\nAnswer directly with yes.',
    "put  the   cube on Bananas!",
)


@pytest.mark.parametrize("name", ["pi0-tiny", "vlm-tiny"])
@pytest.mark.parametrize("text", TEXTS)
def test_words_are_separated_as_the_tokenizer_of_the_checkpoint_does(name: str, text: str) -> None:
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(embedded_checkpoint(name) / "tokenizer.json"))
    tokens = tokenizer.encode(text, add_special_tokens=False).tokens
    assert tokens == [word if word in WORDS else "<unk>" for word in words_in(text)]


@pytest.mark.parametrize("name", EMBEDDED)
def test_an_unknown_word_is_refused_by_name(name: str) -> None:
    family = find_family(name, ())
    family.check_words(TEXTS[:1])
    with pytest.raises(InstructionError, match=r"does not know 'xylophone' in .* 1 further .*models --words"):
        family.check_words(["Put the cube on the xylophone", "Put the cube on the zither"])
    family.check_words(["Put the cube on the xylophone"], checkpoint="a folder with a tokenizer of its own")


def test_other_families_read_any_text() -> None:
    find_family("pi0", ()).check_words(["Put the cube on the xylophone"])


def test_models_words_lists_every_word_and_no_special_token() -> None:
    answer = CliRunner().invoke(app, ["models", "--words"])
    assert answer.exit_code == 0
    listed = answer.stdout.split("\n")
    assert {"red", "square", "cube"} <= set(listed)
    assert set(filter(None, listed)) == {word for word in known_words() if word.strip()}
    assert not set(SPECIAL) & set(listed)
    result = CliRunner().invoke(app, ["models", "vlm-tiny", "--words", "--json"])
    assert json.loads(result.stdout) == list(filter(None, listed))
    other = CliRunner().invoke(app, ["models", "pi0", "--words"])
    assert (other.exit_code, "pi0 reads any text" in other.stderr) == (2, True)


@pytest.mark.parametrize("settings", [ExtractSettings("pi0-tiny"), AskSettings("vlm-tiny")])
def test_a_suite_with_an_unknown_word_is_refused_before_the_model_is_loaded(
    settings: ExtractSettings | AskSettings, tmp_path: Path
) -> None:
    for name in ("red", "blue"):
        Image.new("RGB", (300, 300), name).save(tmp_path / f"{name}.png")
    table = tmp_path / "table.csv"
    table.write_text("instruction,correct,wrong\nPut it on the xylophone,red.png,blue.png\n", encoding="utf-8")
    suite = suite_from_csv(table, tmp_path / "suite", terms=Terms("CC0-1.0", "the test"))
    with pytest.raises(InstructionError, match=r"does not know .*'xylophone'"):
        open_checked(settings.changed(suite=suite.folder))


NAMES = ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state")
VLM = "vlm-tiny"


def test_vlm_and_policy_are_small_and_so_is_all_that_comes_with_the_package() -> None:
    sizes = {
        folder.name: file_size(folder.name)
        for folder in embedded_checkpoint(VLM).parent.iterdir()
        if folder.is_dir()
    }
    assert sizes[VLM] + sizes["pi0-tiny"] < 8_000_000
    assert sum(sizes.values()) < 10_000_000


def file_size(name: str) -> int:
    return (embedded_checkpoint(name) / "model.safetensors").stat().st_size


@pytest.mark.parametrize("name", NAMES)
def test_the_weights_say_how_they_were_made(name: str) -> None:
    path = embedded_checkpoint(name) / "model.safetensors"
    with safe_open(path, "pt") as file:
        assert VLM in file.metadata()["probe_kit.weights"]
        assert all(torch.isfinite(file.get_tensor(key)).all() for key in file.keys())  # noqa: SIM118


def test_the_policy_begins_as_the_vlm_and_is_another_afterwards() -> None:
    """Weight by weight, as far as float16 holds them; an expert beside it that the VLM has not."""
    vlm = weights_of(VLM)
    start, policy = (backbone(weights_of(name)) for name in ("pi0-tiny-early", "pi0-tiny"))
    assert start.keys() - {"lm_head.weight"} == vlm.keys() == policy.keys() - {"lm_head.weight"}
    for name, tensor in vlm.items():
        torch.testing.assert_close(start[name].float(), tensor.half().float(), rtol=0, atol=0)
    assert any((policy[name] - tensor).abs().max() > 0.01 for name, tensor in vlm.items())


def weights_of(name: str) -> dict[str, torch.Tensor]:
    return dict(load_file(embedded_checkpoint(name) / "model.safetensors"))


def backbone(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    prefix = "model.paligemma_with_expert.paligemma."
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


@pytest.mark.parametrize("name", [*NAMES, VLM])
def test_an_embedded_model_is_at_home_where_it_was_trained(name: str) -> None:
    home = SceneSpec.preset("act2answer", early_stop=True, max_steps=40)
    assert (AskSettings if name == VLM else ExtractSettings)(name).scene == home
    assert scene_of(name) == home
    assert scene_of(name, tile_side=0.2) == replace(home, tile_side=0.2)
    assert scene_of(name, name="bridge", max_steps=3) == SceneSpec(max_steps=3)


def test_all_other_families_play_the_released_scene_and_scripts_the_default_one() -> None:
    """A VLM and a policy of one study get the same first frames without an option."""
    released = SceneSpec.preset("act2answer")
    assert (released.arm, released.max_steps, released.start_grasped) == ("widowx", 80, True)
    for name in own_families().keys() - {*NAMES, VLM}:
        assert (scene_of(name), ExtractSettings(name).scene, AskSettings(name).scene) == (released,) * 3
    assert {scene_of(name) for name in ("expert", "idle", "unknown")} == {SceneSpec()}


def test_the_hand_never_turns(pi0_tiny: Pi0) -> None:
    turning = [dimension for dimension in range(7) if dimension not in ACTION_DIMS]
    assert not pi0_tiny.action_units.high[turning].any()
    assert not pi0_tiny.action_units.low[turning].any()


@pytest.mark.slow
def test_color_and_shape_are_answered_far_above_chance(tmp_path: Path) -> None:
    """In 32 episodes that a rate of 0.9 makes rarer than once in a thousand; guessing is at one half."""
    suite = build_suite(tmp_path / "suite", ["color", "shape"], 8)
    run = extract_run(ExtractSettings("pi0-tiny", suite=suite.folder), tmp_path / "run")
    assert run.episodes["is_success"].mean() >= 0.72
    assert (run.episodes["outcome"] == "wrong").mean() <= 0.25
    assert run.episodes["steps"].median() < 40


FOLDER = embedded_checkpoint("vlm-tiny")


@pytest.fixture(scope="module")
def vlm() -> PaliGemma:
    return load_vlm_tiny()


def test_the_weights_that_come_with_the_package_are_small_and_say_how_they_were_made() -> None:
    path = FOLDER / "model.safetensors"
    assert path.stat().st_size < 3_000_000
    with safe_open(path, "pt") as file:
        assert file.metadata()["probe_kit.weights"].startswith("trained")
        assert all(torch.isfinite(file.get_tensor(key)).all() for key in file.keys())  # noqa: SIM118


def test_it_knows_every_word_of_the_suite_in_every_prompt(vlm: PaliGemma) -> None:
    assert set(vocabulary()) <= set(WORDS)
    phrases = {concept.phrase for generator in GENERATORS.values() for pair in generator.pairs for concept in pair}
    longest = 0
    for template in TEMPLATES.values():
        for order in ORDERS:
            for phrase in sorted(phrases):
                prompt = vlm.text.prompt(template.render(Phrase(phrase, "the"), order), picture=[4] * 36)
                longest = max(longest, len(prompt.ids))
    assert longest + template.tokens <= vlm.text_config.max_position_embeddings


def test_transformers_reads_the_same_network_from_the_same_folder(vlm: PaliGemma) -> None:
    theirs = PaliGemmaForConditionalGeneration.from_pretrained(FOLDER).eval()
    picture = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    question = Prompt(Observation(picture, "", np.zeros(8, np.float32)), "Put cube on star", ("A", "B"))
    reading = vlm.read([question])
    ids = torch.tensor([vlm.prompt(question).ids])
    with torch.inference_mode():
        logits = theirs(
            input_ids=ids,
            pixel_values=vlm.picture_inputs([picture])["pixel_values"],
            attention_mask=torch.ones_like(ids),
            token_type_ids=torch.zeros_like(ids),
        ).logits[0, -1]
    options = [vlm.text.option(vlm.prompt(question), letter) for letter in "AB"]
    np.testing.assert_allclose(reading.option_logits[0], logits[options].numpy(), atol=1e-5)


def test_its_attention_mask_is_the_one_that_transformers_makes_of_the_token_types(vlm: PaliGemma) -> None:
    packed = LeftPacked.of([(2, 5, 6, 1), (2, 5, 6, 7, 8, 1)], vlm.text.padding, vlm.loaded.device)
    inputs = vlm.other_inputs(packed)
    theirs = create_causal_mask_mapping(
        vlm.network.config, torch.zeros(*packed.ids.shape, vlm.text_config.hidden_size), packed.mask, None,
        packed.positions(1), inputs["token_type_ids"],
    )  # fmt: skip
    torch.testing.assert_close(inputs["attention_mask"], theirs, rtol=0, atol=0)
    assert not theirs.all(), "the shorter row is padded"


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["bridge", pytest.param("act2answer", marks=pytest.mark.slow)])
def test_it_knows_color_on_pictures_it_has_not_seen(scene: str, tmp_path: Path) -> None:
    """Eight questions, each with the options in both orders."""
    suite = build_suite(tmp_path / "suite", ["color"], 4)
    settings = AskSettings(
        "vlm-tiny", suite=suite.folder, prompt=TEMPLATES["p2"], scene=SceneSpec.preset(scene), frames="none"
    )
    answers = ask_run(settings, tmp_path / "run").episodes
    assert (answers[["outcome", "outcome_swapped"]] == "correct").to_numpy().mean() >= 0.75
