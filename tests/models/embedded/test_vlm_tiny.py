"""The embedded VLM: small enough to ship, readable by transformers itself, and it knows what its card says."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from transformers import PaliGemmaForConditionalGeneration

from probe_kit.env import SceneSpec
from probe_kit.extract import ask_run
from probe_kit.extract.prompts import ORDERS, TEMPLATES, Phrase
from probe_kit.extract.settings import AskSettings
from probe_kit.hooks.contract.model import Prompt
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.paligemma.adapter import PaliGemma, load_vlm_tiny
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.models.embedded.words import WORDS
from probe_kit.suite import build_suite
from probe_kit.suite.generators import GENERATORS, vocabulary

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
    phrases = {concept.phrase for own in GENERATORS.values() for pair in own.pairs for concept in pair}
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
