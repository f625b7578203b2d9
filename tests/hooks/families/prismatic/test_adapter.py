from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import InstructionError, ObservationError, UnknownSiteError, UsageError
from probe_kit.hooks import Observation, Prompt, Site, capture, load_policy
from probe_kit.hooks.families.prismatic.adapter import Prismatic, frame_of, load_prismatic
from tests.support.prismatic_checkpoints import write_checkpoint


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Prismatic:
    folder = write_checkpoint(
        tmp_path_factory.mktemp("phi"), vision="dinoclip-vit-l-336px", language="phi-2-3b", model_type="prismatic"
    )
    return load_prismatic(str(folder), tokenizer="bytes", steps=3)


def test_both_streams_together_are_the_hidden_states_of_one_pass(
    model: Prismatic, observation: Observation
) -> None:
    """Against transformers' own hidden states, for a language model whose block runs attention beside its MLP."""
    prompt, pixels = model.prompt("What is this?"), model.pixel_values([observation.image])
    with capture(model, [*model.sites(), *model.sites("final_norm")]) as tape:
        decoded = model.generate(pixels, [prompt])
    fed = torch.tensor([[*prompt, *decoded.ids[0, :-1].tolist()]])
    with torch.no_grad():
        expected = model.network(fed, torch.ones_like(fed, dtype=torch.bool), pixels).hidden_states
    last = len(expected) - 1
    for layer, states in enumerate(expected):
        quantity = "final_norm" if layer == last else "residual"
        parts = [tape[Site("backbone", layer, quantity)]]
        parts += [tape[Site("answer", layer, quantity, step)] for step in range(3)]
        torch.testing.assert_close(torch.cat(parts, dim=1), states, rtol=0, atol=2e-5)


def test_the_last_site_of_a_tower_is_what_the_projector_reads(model: Prismatic, observation: Observation) -> None:
    pixels = model.pixel_values([observation.image])
    sites = {name: stream.sites()[-1] for name, stream in model.further_streams.items()}
    with capture(model, sites.values()) as tape:
        model.generate(pixels, [model.prompt("What is this?")])
    towers = model.network.vision_backbone.towers
    patches = [
        tape[site][:, tower.num_prefix_tokens :] for site, tower in zip(sites.values(), towers, strict=True)
    ]
    with torch.no_grad():
        expected = model.network.vision_backbone(pixels)
    torch.testing.assert_close(torch.cat(patches, dim=2), expected, rtol=0, atol=0)


def test_roles_name_what_every_position_is(model: Prismatic, observation: Observation) -> None:
    """Beginning, patches, then a byte per letter; the last one belongs to the other stream. The frame is Phi's."""
    asked = replace(observation, instruction="Why?")
    longer = replace(observation, instruction="Why not?")
    short, long = model.roles([asked, longer])["backbone"]
    patches, prompt, start = model.network.patches, len("Input: Why?\nOutput:"), len("Input: ")
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
    vlm, whole = (load_prismatic(folder, tokenizer="bytes", steps=steps) for steps in (1, 6))
    reading = vlm.read([Prompt(observation, "Which?", ("A", "B"))])
    decoded = whole.generate(whole.pixel_values([observation.image]), [whole.prompt("Which?")])
    with torch.inference_mode():
        said = reading.state.speak(6, frozenset())
    assert said.tolist() == decoded.ids.tolist()
    with pytest.raises(UsageError, match="does not come from this model"):
        whole.speak(reading, 3)


def test_a_reading_compares_what_may_stand_behind_the_prompt(
    model: Prismatic, tmp_path: Path, observation: Observation
) -> None:
    vlm = load_prismatic(str(write_checkpoint(tmp_path, model_type="prismatic")), tokenizer="bytes")
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
