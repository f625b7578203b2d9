"""Patterns are the model's own: what eager attention returns, and what transformers' eager computes for fused."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import (
    CaptureError,
    RolesMismatchError,
    UnknownSiteError,
    UnsupportedInterventionError,
    UsageError,
)
from probe_kit.hooks import (
    ActivationCache,
    AnswerModel,
    Model,
    Observation,
    Policy,
    Prompt,
    Reading,
    Roles,
    Site,
    Tap,
    attended_roles,
    capture,
    capture_attention,
    capture_patterns,
    edit,
    load_model,
    logit_lens,
    project_heads,
)
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.paligemma.adapter import PaliGemma
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.outputs import outputs_of
from tests.support.every_checkpoint import WRITERS, families

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens that name no action")
FUSED = (
    "openvla",
    "magma",
    "prismatic",
    "qwen2.5-vl",
    "qwen3-vl",
    "internvl",
    "ovis2.5",
    "paligemma",
    "xiaomi-r0",
)
"""Families whose decoder transformers runs with torch's fused attention."""


def infer(model: Model, observation: Observation) -> NDArray[np.float32]:
    if isinstance(model, Policy):
        return (
            model.act([observation], [3])
            if model.embodiment_mismatch() is None
            else model.infer_without_acting([observation], [3])
        )
    assert isinstance(model, AnswerModel)
    return model.read(
        [Prompt(observation, observation.instruction, tuple(f"{model.lead}{letter}" for letter in "AB"))]
    ).option_logits


def attentions_of(model: Any, sites: list[Site]) -> Mapping[Site, Any]:
    """The modules whose output projection is tapped."""
    network = getattr(model, "network", model)
    owner = {child: module for module in network.modules() for child in module.children()}
    return {site: owner[model.tap(site).module] for site in sites}


def returned_weights(model: Model, sites: list[Site], observation: Observation) -> dict[Site, Tensor]:
    """By site, what plain torch hooks find that eager attention returns beside what it read."""
    with ExitStack() as stack:
        outputs = {site: outputs_of(attention, stack) for site, attention in attentions_of(model, sites).items()}
        infer(model, observation)
    taps = {site: model.tap(site) for site in sites}
    return {
        site: tap.rows.of(outputs[site][tap.first + (site.iteration or 0)][1])[:, :, tap.tokens]
        for site, tap in taps.items()
    }


@pytest.mark.parametrize("stream", ["backbone", "expert"])
def test_patterns_of_eager_attention_are_what_it_returns_bit_for_bit(
    pi0_tiny: Pi0, observation: Observation, stream: str
) -> None:
    sites = pi0_tiny.streams[stream].sites("heads")
    expected = returned_weights(pi0_tiny, sites, observation)
    plain = infer(pi0_tiny, observation)
    with capture_patterns(pi0_tiny, sites) as patterns:
        np.testing.assert_array_equal(infer(pi0_tiny, observation), plain)
    assert list(patterns) == sorted(sites, key=lambda site: (site.iteration or 0, site.layer))
    for site in sites:
        assert torch.equal(patterns[site], expected[site].float())


@pytest.mark.parametrize("family", families(FUSED))
def test_patterns_of_fused_attention_are_those_of_transformers_eager_attention(
    family: str, tmp_path: Path
) -> None:
    write, options = WRITERS[family]
    model = load_model(family, str(write(tmp_path / "checkpoint")), **options)
    (observation,) = examples_for(model, "Put the cube on the star")
    streams = [stream for stream in model.streams.values() if stream.name != "expert"]
    sites = [site for stream in streams for site in stream.sites("heads")]
    with capture_patterns(model, sites) as patterns:
        infer(model, observation)
    for attention in attentions_of(model, sites).values():
        attention.config._attn_implementation = "eager"
    for site, expected in returned_weights(model, sites, observation).items():
        torch.testing.assert_close(patterns[site], expected.float(), rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["pi0-tiny", "vlm-tiny"])
def test_patterns_of_half_precision_are_those_of_the_same_weights_in_full(family: str) -> None:
    """Each is checked with the values of its own call, within what half precision rounds."""
    half, full = load_model(family, dtype="bfloat16"), load_model(family, dtype="float32")
    (observation,) = examples_for(half, "Put the cube on the red shape")
    sites = half.streams["backbone"].sites("heads")
    recorded = []
    for model in (half, full):
        plain = infer(model, observation)
        with capture_patterns(model, sites) as patterns:
            np.testing.assert_array_equal(infer(model, observation), plain)
        recorded.append(patterns)
    for site in sites:
        assert recorded[0][site].dtype == torch.float32
        torch.testing.assert_close(recorded[0][site], recorded[1][site], rtol=0, atol=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
@pytest.mark.parametrize(
    "family", ["pi0", "pi05", "pi0-fast", "smolvla", "openvla", "spatialvla", "magma", "xiaomi-r0"]
)
def test_the_acting_streams_patterns_on_the_prompt_are_its_recorded_attention(family: str, tmp_path: Path) -> None:
    """Each family records that in code of its own."""
    write, options = WRITERS[family]
    model = load_model(family, str(write(tmp_path / "checkpoint")), **options)
    assert isinstance(model, Policy)
    (observation,) = examples_for(model, "Put the cube on the star")
    (stream,) = (action_stream for action_stream in model.streams.values() if action_stream.part == "action")
    with capture_patterns(model, stream.sites("heads")) as patterns:
        infer(model, observation)
    with capture_attention(model) as mass:
        infer(model, observation)
    roles = model.roles([observation])
    acting = torch.from_numpy(roles[stream.name][0].mask("action"))
    tokens = len(roles["backbone"][0])
    blocks = sorted({block for block, _ in mass.by_head})
    for site, pattern in patterns.items():
        share = mass.by_head[blocks[site.layer], site.iteration or 0]
        np.testing.assert_allclose(pattern[:, :, acting, :tokens].mean(dim=2), share, rtol=1e-4, atol=1e-6)


def test_the_roles_of_what_is_attended_to_are_the_prompts_then_the_acting_streams(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    site, roles = Site("expert", 1, "heads", 9), pi0_tiny.token_roles([observation])
    with capture_patterns(pi0_tiny, [site, Site("backbone", 0, "heads")]) as patterns:
        infer(pi0_tiny, observation)
    (keys,) = attended_roles(pi0_tiny, roles, site, patterns[site].shape[-1])
    prompt, suffix = roles["backbone"][0], roles["expert"][0]
    assert len(keys) == len(prompt) + len(suffix) == patterns[site].shape[-1]
    assert (keys.mask("image") == np.append(prompt.mask("image"), np.zeros(len(suffix), bool))).all()
    assert keys.mask("action").sum() == suffix.mask("action").sum()
    (attended,) = attended_roles(pi0_tiny, roles, Site("backbone", 0, "heads"), len(prompt))
    assert attended == prompt
    with pytest.raises(RolesMismatchError, match=r"attends to 60 positions; backbone has 52 and expert 17"):
        attended_roles(pi0_tiny, roles, site, 60)
    with pytest.raises(RolesMismatchError, match="tokens of vision have no roles"):
        attended_roles(pi0_tiny, roles, Site("vision", 0, "heads", 0), 36)


def test_a_decoders_positions_attend_to_the_tokens_that_were_put_out_before() -> None:
    vlm = load_model("vlm-tiny")
    roles = {
        "backbone": [Roles.from_labels(["image.primary", "language"])],
        "answer": [Roles.from_labels(["answer"])],
    }
    for site in (Site("answer", 0, "heads", 0), Site("backbone", 0, "heads")):
        (keys,) = attended_roles(vlm, roles, site, 3)
        assert [span.role for span in keys.spans] == ["image.primary", "language", "answer"]


def test_another_quantity_has_no_pattern(pi0_tiny: Pi0) -> None:
    expected = r"backbone\.01\.residual has no attention pattern; expected .* such as backbone\.01\.heads"
    with pytest.raises(UnknownSiteError, match=expected), capture_patterns(pi0_tiny, [Site("backbone", 1)]):
        pass


def test_more_than_the_limit_is_refused_with_the_number(pi0_tiny: Pi0, observation: Observation) -> None:
    sites = pi0_tiny.streams["backbone"].sites("heads")
    with pytest.raises(UsageError, match=r"of 3 sites take more than 0\.00 GB, with 0\.\d MB at backbone"):
        capture_into(pi0_tiny, sites, observation, most_bytes=100_000)


def capture_into(model: Model, sites: list[Site], observation: Observation, most_bytes: int = 10**9) -> None:
    with capture_patterns(model, sites, most_bytes):
        infer(model, observation)


def test_a_tap_that_is_not_directly_behind_the_attention_is_an_error(
    pi0_tiny: Pi0, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, right = Site("backbone", 1, "heads"), pi0_tiny.tap
    monkeypatch.setattr(pi0_tiny, "tap", lambda tap: right(replace(tap, quantity="residual")))
    with pytest.raises(CaptureError, match=r"in front of backbone\.01\.heads does not give what its heads read"):
        capture_into(pi0_tiny, [site], observation)


def test_a_wrong_number_of_heads_is_an_error(
    pi0_tiny: Pi0, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    streams = {name: replace(stream, heads=2 * stream.heads) for name, stream in pi0_tiny.streams.items()}
    heads = pi0_tiny.streams["backbone"].heads
    monkeypatch.setattr(pi0_tiny, "streams", streams)
    with pytest.raises(CaptureError, match=rf"has {heads} heads .*; expected {2 * heads} and"):
        capture_into(pi0_tiny, [Site("backbone", 1, "heads")], observation)


class _Attending(nn.Module):
    """An attention that torch's functions do not show, as a kernel of another library."""

    def __init__(self) -> None:
        super().__init__()
        self.projection = nn.Linear(4, 4)

    def forward(self, tokens: Tensor) -> Tensor:
        shares = (tokens @ tokens.mT).exp()
        read: Tensor = self.projection(shares / shares.sum(dim=-1, keepdim=True) @ tokens)
        return read


def test_attention_of_another_library_is_an_error_that_says_what_to_load(
    pi0_tiny: Pi0, observation: Observation, monkeypatch: pytest.MonkeyPatch
) -> None:
    attending = _Attending()
    monkeypatch.setattr(pi0_tiny, "tap", lambda _: Tap(attending.projection, 1))
    monkeypatch.setattr(pi0_tiny, "act", lambda *_: attending(torch.ones(1, 3, 4)))
    with pytest.raises(CaptureError, match="Load the model with the attention sdpa or eager"):
        capture_into(pi0_tiny, [Site("backbone", 1, "heads")], observation)


def test_rows_that_attend_to_nothing_are_zero_and_a_capture_inside_is_refused(tmp_path: Path) -> None:
    model = load_model("qwen3-vl", str(WRITERS["qwen3-vl"][0](tmp_path / "checkpoint")))
    assert isinstance(model, AnswerModel)
    short, long = examples_for(model, "Put", "Put the cube on the red shape")
    questions = [Prompt(observation, observation.instruction, ("A", "B")) for observation in (short, long)]
    site = Site("backbone", 1, "heads")
    with capture_patterns(model, [site]) as patterns:
        with pytest.raises(CaptureError, match="captured already"), capture(model, [site]):
            pass
        model.read(questions)
    valid = torch.from_numpy(model.asked_roles(questions)["backbone"][0].valid)
    sums = patterns[site][0].sum(dim=-1)
    torch.testing.assert_close(sums[:, valid], torch.ones_like(sums[:, valid]))
    assert (sums[:, ~valid] == 0).all()


@pytest.mark.parametrize(("stream", "iteration"), [("backbone", None), ("expert", 6), ("vision", 0)])
def test_every_head_adds_its_columns_of_the_projection_and_all_make_the_attention(
    pi0_tiny: Pi0, observation: Observation, stream: str, iteration: int | None
) -> None:
    site = Site(stream, 1, "heads", iteration)
    attention = Site(stream, 1, "attention", iteration)
    with capture(pi0_tiny, [site, attention]) as activations:
        pi0_tiny.act([observation], [0])
    projection, heads = pi0_tiny.tap(site).module, pi0_tiny.every_stream()[stream].heads
    added = project_heads(pi0_tiny, activations, site)
    assert added.shape == (heads, *activations[attention].shape)
    weight, bias = projection.weight.detach(), projection.bias
    size = weight.shape[1] // heads
    for head in range(heads):
        columns = slice(head * size, (head + 1) * size)
        torch.testing.assert_close(
            added[head], activations[site][..., columns] @ weight[:, columns].T, rtol=1e-4, atol=1e-5
        )
    summed = added.sum(dim=0) + (0 if bias is None else bias.detach())
    torch.testing.assert_close(summed, activations[attention], rtol=1e-4, atol=1e-5)


def test_a_site_by_name_is_the_same_and_another_quantity_is_refused(
    pi0_tiny: Pi0, observation: Observation
) -> None:
    with capture(pi0_tiny, [Site("backbone", 1, "heads"), Site("backbone", 1)]) as activations:
        pi0_tiny.act([observation], [0])
    by_name = project_heads(pi0_tiny, activations, "backbone.01.heads")
    assert torch.equal(by_name, project_heads(pi0_tiny, activations, Site("backbone", 1, "heads")))
    with pytest.raises(UnknownSiteError, match=r"not of heads; expected backbone\.01\.heads"):
        project_heads(pi0_tiny, activations, Site("backbone", 1))
    with pytest.raises(UnknownSiteError, match="was not captured"):
        project_heads(pi0_tiny, activations, Site("backbone", 2, "heads"))


def test_an_edit_of_heads_writes_what_a_plain_torch_hook_writes(pi0_tiny: Pi0, observation: Observation) -> None:
    site = Site("backbone", 1, "heads")
    module = pi0_tiny.tap(site).module

    def silence(passing: torch.Tensor) -> torch.Tensor:
        passing[..., :16] = 0
        return passing

    handle = module.register_forward_pre_hook(lambda _, inputs: (silence(inputs[0].clone()),))
    expected = pi0_tiny.act([observation], [0])
    handle.remove()
    with edit(pi0_tiny, {site: silence}):
        edited = pi0_tiny.act([observation], [0])
    assert (edited == expected).all()
    assert (edited != pi0_tiny.act([observation], [0])).any()


def test_heads_of_a_stream_that_has_none_are_refused_with_what_there_is(pi0_tiny: Pi0) -> None:
    assert pi0_tiny.prompt_kv is not None
    with pytest.raises(UnknownSiteError, match="the stream kv has no quantity 'heads'; it has keys, values"):
        pi0_tiny.prompt_kv.sites("heads")
    with pytest.raises(
        UnknownSiteError, match=r"backbone: 4 layers of residual, attention, mlp, final_norm, heads"
    ):
        pi0_tiny.tap(Site("backbone", 9, "heads"))


TEXT = (
    "Put cube on red shape\n\nA left\nB right\n\nAnswer with the option's letter from the given choices directly."
)


@pytest.fixture(scope="module")
def vlm() -> PaliGemma:
    model = load_model("vlm-tiny")
    assert isinstance(model, PaliGemma)
    return model


@pytest.fixture
def read(vlm: PaliGemma, observation: Observation) -> tuple[ActivationCache, Reading]:
    with capture(vlm, vlm.sites()) as cache:
        reading = vlm.read([Prompt(observation, TEXT, ("A", "B"))])
    return cache, reading


def test_the_last_row_is_the_output_exactly(vlm: PaliGemma, read: tuple[ActivationCache, Reading]) -> None:
    cache, reading = read
    vocabulary = range(int(vlm.text_config.vocab_size))
    lens = logit_lens(vlm, cache, vocabulary)
    assert lens.layers == (0, 1, 2, 3)
    assert lens.logits.shape == (4, 1, len(vocabulary))
    assert np.isin(reading.option_logits, lens.logits[-1]).all()
    assert np.array_equal(lens.logits[-1], reading.state.logits.float().numpy())


@pytest.mark.parametrize(("stream", "at"), [("answer", -1), ("backbone", 5)])
def test_every_layer_is_final_norm_and_head_of_its_residual(
    vlm: PaliGemma, read: tuple[ActivationCache, Reading], stream: str, at: int
) -> None:
    cache, _ = read
    lens = logit_lens(vlm, cache, ids=(7, 3), at=at, stream=stream)
    language = vlm.network.model.language_model
    for layer, residual in enumerate(cache.stack(stream)):
        with torch.inference_mode():
            plain = vlm.network.lm_head(language.norm(residual.reshape(-1, 1, residual.shape[-2], 96)[0, :, at]))
        np.testing.assert_allclose(lens.logits[layer], plain[:, [7, 3]].numpy(), rtol=1e-5, atol=1e-5)


def test_without_ids_the_likeliest_tokens_of_every_layer_come_first(
    vlm: PaliGemma, read: tuple[ActivationCache, Reading]
) -> None:
    cache, _ = read
    lens = logit_lens(vlm, cache, k=3)
    every = logit_lens(vlm, cache, range(int(vlm.text_config.vocab_size))).logits
    assert (lens.logits[..., 0] == every.max(axis=-1)).all()
    assert (np.diff(lens.logits, axis=-1) <= 0).all()
    assert (np.take_along_axis(every, lens.ids, axis=-1) == lens.logits).all()


def test_an_impossible_readout_is_refused(
    vlm: AnswerModel, read: tuple[ActivationCache, Reading], pi0_tiny: Pi0
) -> None:
    cache, _ = read
    with pytest.raises(UsageError, match=r"ids are \[-1\]; expected one or more from 0 to"):
        logit_lens(vlm, cache, [-1])
    with pytest.raises(UsageError, match=r"ids are \[\]"):
        logit_lens(vlm, cache, [])
    with pytest.raises(
        UnknownSiteError, match="does not read the stream 'vision'; expected one of backbone, answer"
    ):
        logit_lens(vlm, cache, stream="vision")
    with pytest.raises(UnknownSiteError, match=r"no residual of answer at iteration 4 was captured; capture"):
        logit_lens(vlm, cache, iteration=4)
    with pytest.raises(UnknownSiteError, match=r"no residual of answer was captured"):
        logit_lens(vlm, ActivationCache())
    with pytest.raises(UnsupportedInterventionError, match="pi0-tiny has no logit lens: it puts out no tokens"):
        logit_lens(pi0_tiny, cache)
