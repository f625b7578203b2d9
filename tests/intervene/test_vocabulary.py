"""The words of feed-forward units: scores, chance, files of directions, and models without a vocabulary."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import hypergeom
from torch import nn
from typer.testing import CliRunner

from probe_kit.cli import app
from probe_kit.errors import UnsupportedInterventionError, UsageError
from probe_kit.hooks import Model, capture, load_model
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.family import Family
from probe_kit.hooks.registry import own_families
from probe_kit.intervene import value_words
from probe_kit.intervene.vocabulary import ValueWords, value_vectors
from probe_kit.runs.direction_files import read_direction
from probe_kit.suite import Suite
from tests.support.acting_checkpoints import FAMILIES


@pytest.fixture(scope="module")
def policy() -> Model:
    return load_model("pi0-tiny")


@pytest.fixture(scope="module")
def words(policy: Model) -> ValueWords:
    return value_words(policy)


def decoder_of(policy: Model) -> nn.Module:
    joint: nn.Module = policy.network.model.paligemma_with_expert.paligemma.model.language_model  # type: ignore[attr-defined]
    return joint


def test_scores_are_those_of_gemmas_norm_and_embedding(policy: Model, words: ValueWords) -> None:
    """By the formula: (v / rms(v)) · (1 + w), times every row of the embedding."""
    decoder = decoder_of(policy)
    embedding = decoder.embed_tokens.weight.detach().double().numpy()
    scale = 1 + decoder.norm.weight.detach().double().numpy()
    row = 200
    block, unit = int(words.blocks[row]), int(words.units[row])
    vector = decoder.layers[block].mlp.down_proj.weight.detach().double().numpy()[:, unit]
    scores = embedding @ (vector / np.sqrt((vector**2).mean() + 1e-6) * scale)
    scores[[not text for text in words.texts]] = -np.inf
    first = np.argsort(-scores)[: words.token_ids.shape[1]]
    assert words.token_ids[row].tolist() == first.tolist()
    np.testing.assert_allclose(words.scores[row], scores[first], rtol=1e-4)


def test_a_unit_adds_its_value_vector_times_its_activation_to_the_residual_stream(policy: Model) -> None:
    mlp = decoder_of(policy).layers[1].mlp
    observation = Observation(np.zeros((64, 64, 3), np.uint8), np.zeros(8, np.float32), "put the cube on the left")
    site, unit = Site("backbone", 1, "mlp"), 7

    def added(more: float) -> torch.Tensor:
        def raise_activation(_: nn.Module, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
            activations = inputs[0].clone()
            activations[..., unit] += more
            return (activations,)

        handle = mlp.down_proj.register_forward_pre_hook(raise_activation)
        try:
            with capture(policy, [site]) as cache:
                policy.predict([observation], [0])  # type: ignore[attr-defined]
        finally:
            handle.remove()
        return cache[site]

    moved = (added(3.0) - added(0.0))[0, 0]
    torch.testing.assert_close(moved, 3.0 * value_vectors(policy, 1)[unit], rtol=1e-3, atol=1e-4)


def test_a_planted_word_is_the_first_token_of_its_unit(words: ValueWords) -> None:
    policy = load_model("pi0-tiny")
    decoder = decoder_of(policy)
    number = words.tokens_of_words(["umbrella"])[0]
    row = decoder.embed_tokens.weight[number].detach() / (1 + decoder.norm.weight.detach())
    with torch.no_grad():
        decoder.layers[2].mlp.down_proj.weight[:, 11] = row / row.norm()
    planted = value_words(policy, [2])
    assert planted.words_of(11)[0] == "umbrella"
    assert planted.match(["Umbrella "]).token_ids == (number,)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_the_expected_number_of_matches_is_the_mean_over_shuffles(words: ValueWords, count: int) -> None:
    names = [text for text in words.texts if text.isalpha()][:count]
    match = words.match(names, shuffles=400)
    first = words.token_ids.shape[1]
    share = 1 - hypergeom.pmf(0, words.scored, len(match.token_ids), first)
    assert match.expected == pytest.approx(len(words) * share)
    draw = np.random.default_rng(1)
    texts = np.flatnonzero([bool(text) for text in words.texts])
    counts = [
        np.isin(words.token_ids, draw.choice(texts, len(match.token_ids), replace=False)).any(axis=1).sum()
        for _ in range(400)
    ]
    assert match.expected == pytest.approx(np.mean(counts), abs=4 * np.std(counts) / 20)


def test_words_that_a_shuffle_drew_are_significant_in_one_of_twenty_cases(words: ValueWords) -> None:
    draw = np.random.default_rng(2)
    names = [text for text in words.texts if text.isalpha()]
    p = [words.match(draw.choice(names, 2, replace=False).tolist(), 99, seed).p for seed in range(200)]
    assert np.mean(np.array(p) <= 0.05) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)


def test_a_word_of_several_tokens_is_refused_with_its_longest_beginning(words: ValueWords) -> None:
    with pytest.raises(UsageError, match=r"spells 'redder'.* longest beginning that is a token is 'red'"):
        words.match(["red", "redder"])


def test_no_token_without_a_text_is_listed(words: ValueWords) -> None:
    assert words.scored < len(words.texts)
    assert all(words.texts[number] for number in words.token_ids.ravel())


def test_value_vectors_are_written_as_directions_of_the_site_that_the_block_enters(
    policy: Model, words: ValueWords, tmp_path: Path
) -> None:
    file, row = tmp_path / "words.safetensors", 300
    words.write(file, policy, [0, row])
    direction = read_direction(f"{file}#{words.direction_name(row)}")
    block = int(words.blocks[row])
    assert (direction.site, direction.weights) == (f"backbone.{block + 1:02d}", policy.card.weights_sha256)
    np.testing.assert_allclose(
        direction.vectors[0], value_vectors(policy, block)[int(words.units[row])], rtol=1e-6
    )


def test_a_feed_forward_part_that_ends_in_a_norm_is_refused() -> None:
    """As in Gemma 2, where a norm comes behind the last linear map."""

    class Normed(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.down, self.norm = nn.Linear(96, 96), nn.RMSNorm(96)

        def forward(self, values: torch.Tensor) -> torch.Tensor:
            normed: torch.Tensor = self.norm(self.down(values))
            return normed

    changed = load_model("pi0-tiny")
    decoder_of(changed).layers[0].mlp = Normed()
    with pytest.raises(UnsupportedInterventionError, match=r"block 0 of pi0-tiny .*does not end in one linear"):
        value_words(changed, [0])


def test_a_model_without_words_is_refused_by_name(policy: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(policy), "word_head", None)
    with pytest.raises(UnsupportedInterventionError, match="pi0-tiny has no vocabulary in its backbone"):
        value_words(policy)


WITHOUT_WORDS = [name for name, family in own_families().items() if family.abilities.no_words]


@pytest.mark.parametrize("name", WITHOUT_WORDS)
def test_a_family_without_words_is_refused_before_its_weights_are_looked_for(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def not_checked(*_: object, **__: object) -> None:
        raise AssertionError("nothing of the checkpoint is needed for this")

    monkeypatch.setattr(Family, "check", not_checked)
    monkeypatch.setattr(Family, "load", not_checked)
    answer = CliRunner().invoke(app, ["words", name, "--random-weights"])
    assert answer.exit_code == 2
    assert f"probe-kit words cannot read {name}: " in " ".join(answer.output.split())


def test_an_unknown_model_option_is_refused_before_the_weights_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Family, "load", lambda *_, **__: pytest.fail("it was loaded"))
    answer = CliRunner().invoke(app, ["words", "pi0-tiny", "-M", "sise=small"])
    assert answer.exit_code == 2
    assert "pi0-tiny has no model option sise" in answer.output


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_what_families_say_of_their_words_is_true_of_loaded_models(
    name: str, small_suite: Suite, tmp_path: Path
) -> None:
    family, tiny = own_families()[name], FAMILIES[name]
    model = load_model(name, tiny.prepare_checkpoint(small_suite, tmp_path), **tiny.options)
    if family.abilities.no_words:
        with pytest.raises(UnsupportedInterventionError):
            value_words(model, tokens=1)
    else:
        assert len(value_words(model, tokens=1)) > 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--layers", "9"), "block 9 is not one of the 3 blocks"),
        (("--layers", "x"), "expected numbers of blocks"),
        (("--out", "words.csv"), "no file of directions"),
        (("--like", "zebrafish"), "no single token of pi0-tiny spells 'zebrafish'"),
        (("--tokens", "700"), "expected 1 to 450"),
    ],
)
def test_words_refuses_what_it_cannot_read(options: tuple[str, ...], message: str) -> None:
    answer = CliRunner().invoke(app, ["words", "pi0-tiny", *options])
    assert answer.exit_code == 2
    assert message in " ".join(answer.output.split())


def test_listed_units_hold_a_word_and_the_count_is_of_all_units(tmp_path: Path) -> None:
    file = tmp_path / "w.npz"
    answer = CliRunner().invoke(
        app, ["words", "pi0-tiny", "--like", "red,blue", "--units", "3", "--out", str(file), "--json"]
    )
    assert answer.exit_code == 0, answer.output
    printed = json.loads(answer.stdout)
    assert len(printed["listed"]) == 3 < printed["like"]["units"] < printed["units"] == 576
    assert all({"red", "blue"} & set(unit["tokens"]) for unit in printed["listed"])
    assert read_direction(f"{file}#{printed['listed'][0]['direction']}").vectors.shape == (1, 96)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["paligemma", "qwen2.5-vl", "qwen3-vl", "internvl", "ovis2.5"])
def test_every_vlm_with_a_gated_block_is_read(family: str, golden_vlm: Path) -> None:
    folder = golden_vlm / family.replace(".", "_").replace("-", "_") / "checkpoint"
    model = load_model(family, str(folder))
    read = value_words(model, tokens=3)
    assert len(read) == sum(len(value_vectors(model, block)) for block in set(read.blocks.tolist()))
    assert np.isfinite(read.scores).all()
