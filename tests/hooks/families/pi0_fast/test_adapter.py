"""FAST's tokens become the chunk they were made of, and what is no chunk is said."""

import json
import shutil
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.pi0_fast.processor_pi0_fast import Pi0FastPrepareStateAndLanguageTokenizerProcessorStep
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer
from tokenizers.decoders import ByteLevel as Bytes
from tokenizers.models import BPE
from tokenizers.pre_tokenizers import ByteLevel

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks import Observation, capture
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.pi0_fast.adapter import ActionText, FastTokenizer, Pi0Fast
from tests.hooks.families.pi0_fast.checkpoints import (
    ACTIONS,
    CHUNK,
    HEAD,
    INSTRUCTIONS,
    TRAINED,
    fast_processor,
    smooth_chunks,
    write_pi0_fast,
)


@pytest.fixture(scope="module")
def fast_files(golden_pi0_fast: Path) -> Path:
    return golden_pi0_fast / "checkpoint" / "fast"


@pytest.fixture(scope="module")
def fast(fast_files: Path) -> FastTokenizer:
    return FastTokenizer.from_folder(fast_files)


@pytest.fixture
def text(fast: FastTokenizer) -> ActionText:
    return ActionText(fast, last=999, begin=(5, 6), end=7)


def encoded(fast: FastTokenizer, coefficients: NDArray[np.int64]) -> list[int]:
    """Tokens of coefficients (H, D), by the byte pairs alone."""
    ids: list[int] = fast.pieces.encode("".join(map(chr, coefficients.ravel() - fast.least))).ids
    return ids


def test_a_chunk_is_the_sum_of_cosines_that_its_coefficients_weigh(fast: FastTokenizer) -> None:
    """The formula of the orthonormal inverse transform, written out."""
    coefficients = np.random.default_rng(0).integers(-9, 9, (CHUNK, ACTIONS))
    chunk = fast.decode(encoded(fast, coefficients), CHUNK, ACTIONS)
    step, order = np.meshgrid(np.arange(CHUNK), np.arange(CHUNK), indexing="ij")
    cosines = np.cos(np.pi * (2 * step + 1) * order / (2 * CHUNK)) * np.sqrt(2 / CHUNK)
    cosines[:, 0] = np.sqrt(1 / CHUNK)
    np.testing.assert_allclose(chunk.values, cosines @ coefficients / fast.scale, atol=1e-12)
    assert chunk.problems == ()


@pytest.mark.slow  # lerobot's class takes seconds to import
def test_tokens_of_lerobots_class_decode_as_lerobots_class_decodes_them(
    fast: FastTokenizer, fast_files: Path
) -> None:
    """Its encoding loses coefficients that it was not trained on. It then decodes zeros; here it is a problem."""
    theirs, chunks = fast_processor(fast_files), smooth_chunks(40, seed=7)
    tokens = theirs(chunks)
    expected_chunks = theirs.decode(tokens, time_horizon=CHUNK, action_dim=ACTIONS)
    decoded = [fast.decode(row, CHUNK, ACTIONS) for row in tokens]
    assert 1 <= sum(bool(decoded_chunk.problems) for decoded_chunk in decoded) <= 20
    for ours, expected, chunk in zip(decoded, expected_chunks, chunks, strict=True):
        if ours.problems:
            assert not expected.any()
            assert ours.values.any()
        else:
            np.testing.assert_array_equal(ours.values, expected)
            assert np.abs(ours.values - chunk).max() < np.sqrt(CHUNK) / fast.scale


def test_what_is_no_whole_chunk_is_a_problem_and_never_zeros_in_silence(fast: FastTokenizer) -> None:
    encoded_chunk = encoded(fast, np.full((CHUNK, ACTIONS), 3))
    short, long = (encoded(fast, np.full((rows, ACTIONS), 3)) for rows in (CHUNK - 1, CHUNK + 1))
    assert fast.decode(encoded_chunk, CHUNK, ACTIONS).problems == ()
    for ids, problem in (
        (short, "21 coefficients; a chunk has 4 x 7"),
        (long, "35 coefficients; a chunk has 4 x 7"),
        ([*encoded_chunk, -1, fast.size], f"2 of {len(encoded_chunk) + 2} tokens name no FAST token"),
        ([], "0 coefficients; a chunk has 4 x 7"),
    ):
        chunk = fast.decode(ids, CHUNK, ACTIONS)
        assert problem in chunk.problems
        assert chunk.values.shape == (CHUNK, ACTIONS)
        assert np.isfinite(chunk.values).all()
    np.testing.assert_array_equal(
        fast.decode(long, CHUNK, ACTIONS).values, fast.decode(encoded_chunk, CHUNK, ACTIONS).values
    )


def test_half_a_character_is_a_problem_and_no_huge_coefficient() -> None:
    """lerobot counts the sign for a broken character as a coefficient of 65 thousand."""
    pieces = Tokenizer(BPE({byte: index for index, byte in enumerate(ByteLevel.alphabet())}, []))
    pieces.pre_tokenizer, pieces.decoder = ByteLevel(add_prefix_space=False, use_regex=False), Bytes()
    fast = FastTokenizer(pieces, 10, -200)
    ids = encoded(fast, np.full((CHUNK, ACTIONS), 3))
    assert len(ids) == 2 * CHUNK * ACTIONS  # chr(203) is two bytes
    assert fast.decode(ids, CHUNK, ACTIONS).problems == ()
    chunk = fast.decode(ids[:-1], CHUNK, ACTIONS)
    assert "the tokens break 1 characters apart" in chunk.problems
    assert np.abs(chunk.values).max() < 10


def test_any_tokens_whatever_give_numbers(text: ActionText) -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        chunk = text.decode(rng.integers(0, 1010, rng.integers(0, 30)).tolist(), CHUNK, ACTIONS)
        assert np.isfinite(chunk.values).all()
        assert chunk.problems


def test_a_row_begins_and_ends_as_it_was_trained_to(text: ActionText, fast: FastTokenizer) -> None:
    ids = encoded(fast, np.full((CHUNK, ACTIONS), 3))
    row = text.ids(ids)
    assert row[:2] == [5, 6]
    assert row[-1] == 7
    assert text.decode([*row, 123, 5], CHUNK, ACTIONS).problems == ()
    assert text.decode(row[:-1], CHUNK, ACTIONS).problems == (f"no end of the actions in {len(row) - 1} tokens",)
    assert text.decode(row[2:], CHUNK, ACTIONS).problems == ('the tokens do not begin with "Action: "',)
    np.testing.assert_array_equal(
        text.decode([*row[:4], 5, 6, *row[4:]], CHUNK, ACTIONS).values, text.decode(row, CHUNK, ACTIONS).values
    )


def test_a_text_tokenizer_that_has_no_room_for_them_is_refused(fast: FastTokenizer) -> None:
    with pytest.raises(CheckpointError, match="do not fit"):
        ActionText.of(SimpleNamespace(vocab_size=fast.size), fast, 4, checked=True)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("processor_config.json", None),
        ("tokenizer.json", None),
        ("processor_config.json", "{}"),
        ("processor_config.json", json.dumps({"scale": 0, "min_token": 0})),
        ("tokenizer.json", "{"),
    ],
)
def test_damaged_files_are_refused(fast_files: Path, tmp_path: Path, name: str, content: str | None) -> None:
    folder = shutil.copytree(fast_files, tmp_path / "fast")
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_text(content, encoding="utf-8")
    with pytest.raises(CheckpointError, match="fast"):
        FastTokenizer.from_folder(folder)


EMBEDDING = "model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.fixture(scope="module")
def folder(golden_pi0_fast: Path) -> Path:
    return golden_pi0_fast / "checkpoint"


@pytest.fixture(scope="module")
def pi0_fast(folder: Path) -> Pi0Fast:
    return Pi0Fast.load(str(folder))


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Pi0Fast:
    return Pi0Fast.load(str(write_pi0_fast(tmp_path_factory.mktemp("untrained"))))


@pytest.fixture
def observations(pi0_fast: Pi0Fast) -> list[Observation]:
    return examples_for(pi0_fast, *INSTRUCTIONS)


def test_whole_chunks_are_acted_on_without_a_flag(pi0_fast: Pi0Fast, observations: list[Observation]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        actions = pi0_fast.act(observations, [0, 0])
    assert pi0_fast.flagged is not None
    assert not pi0_fast.flagged.any()
    expected = pi0_fast.action_units.restore(TRAINED)
    assert (
        np.abs(actions - expected).max()
        <= 0.1 * np.abs(pi0_fast.action_units.slopes(np.zeros(7, np.float32))).max()
    )


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_tokens_are_those_of_lerobots_sampling(
    untrained: Pi0Fast, observations: list[Observation], dtype: str
) -> None:
    fast = untrained if dtype == "float32" else Pi0Fast.load(str(untrained.folder), dtype=dtype)
    batch, policy = fast.batch(observations), fast.network
    ours = fast.tokens(batch, [0, 0])
    policy.model._paligemma_tokenizer = fast.tokenizer
    pictures, masks = policy._preprocess_images(batch)
    text = (batch["observation.language.tokens"], batch["observation.language.attention_mask"])
    with torch.inference_mode():
        theirs = policy.model.sample_actions_fast_kv_cache(pictures, masks, *text, ours.shape[1])
    assert torch.equal(ours, theirs)
    assert ours.unique().numel() > 5


def test_the_instruction_keeps_its_case_as_in_lerobot_or_loses_it_as_in_openpi(
    folder: Path, pi0_fast: Pi0Fast, observations: list[Observation]
) -> None:
    lower = Pi0Fast.load(str(folder), lowercase=True)
    text, state = [observations[0].instruction.title()], np.zeros((1, 7), np.float32)
    assert text[0] != text[0].lower()
    assert pi0_fast.prompts(text, state)[0].startswith(f"Task: {text[0]}, State:")
    assert lower.prompts(text, state) == pi0_fast.prompts([text[0].lower()], state)
    assert lower.token_ids(text) == pi0_fast.token_ids([text[0].lower()])
    assert any("openpi writes lower case" in note for note in pi0_fast.card.notes)
    assert lower.card.settings["lowercase"] == "True"
    Pi0Fast.check_words(str(folder), text, lowercase=True)


def test_the_card_says_where_lerobot_decodes_another_number_of_actions(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "config.json"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"n_action_steps": 4', '"n_action_steps": 2'), encoding="utf-8")
    notes = [Pi0Fast.load(str(checkpoint)).card.notes for checkpoint in (folder, tmp_path)]
    assert [any("lerobot decodes 2" in note for note in card_note) for card_note in notes] == [False, True]


def test_a_chunk_that_does_not_end_is_flagged_and_warned_of(folder: Path, observations: list[Observation]) -> None:
    cut = Pi0Fast.load(str(folder))
    cut.config.max_decoding_steps = 12
    with pytest.warns(UserWarning, match="no whole chunk of actions"):
        actions = cut.act(observations, [0, 0])
    assert all("no end of the actions in 12 tokens" in row for row in cut.problems)
    assert cut.flagged is not None
    assert cut.flagged.all()
    assert np.isfinite(actions).all()


def test_a_row_that_has_ended_does_not_flag_for_the_tokens_behind_its_end(
    pi0_fast: Pi0Fast, observations: list[Observation]
) -> None:
    """One row ends before the other, and is decoded until that one ends."""
    ids, end = pi0_fast.tokens(pi0_fast.batch(observations), [0, 0]), pi0_fast.action_text.end
    ends = (ids == end).int().argmax(dim=1)
    assert ends[0] != ends[1]
    assert ids.shape[1] == ends.max() + 1


def test_more_tokens_are_captured_than_a_row_needs(folder: Path, observations: list[Observation]) -> None:
    policy = Pi0Fast.load(str(folder), captured_tokens=23)
    with capture(policy, policy.streams["action"].sites()) as cache:
        policy.act(observations, [0, 0])
    assert len(cache) == 23 * policy.streams["action"].layers
    assert policy.flagged is not None
    assert not policy.flagged.any()


@pytest.mark.parametrize("captured", [0, 25])
def test_a_number_of_captured_tokens_that_never_come_is_refused(folder: Path, captured: int) -> None:
    with pytest.raises(UsageError, match="expected 1 to 24"):
        Pi0Fast.load(str(folder), captured_tokens=captured)


def test_drawn_tokens_come_from_the_rows_own_seed(folder: Path, observations: list[Observation]) -> None:
    policy = Pi0Fast.load(str(folder), temperature=3.0)
    batch = policy.batch([observations[0], observations[0], observations[1]])
    ids = policy.tokens(batch, [1, 2, 1])
    assert not torch.equal(ids[0], ids[1])
    alone = policy.tokens(policy.batch([observations[0]]), [2])[0]
    shared = min(len(alone), ids.shape[1])
    assert torch.equal(ids[1, :shared], alone[:shared])


def test_half_precision_acts_as_captured_and_puts_out_whole_chunks(
    folder: Path, observations: list[Observation]
) -> None:
    policy = Pi0Fast.load(str(folder), dtype="bfloat16")
    assert policy.card.dtype == "bfloat16"
    plain = policy.act(observations, [0, 0])
    with capture(policy, policy.sites()) as cache:
        np.testing.assert_array_equal(policy.act(observations, [0, 0]), plain)
    assert cache["action.01.residual@3"].dtype == torch.bfloat16
    assert policy.flagged is not None
    assert not policy.flagged.any()


def test_prompts_are_those_of_lerobots_processor(pi0_fast: Pi0Fast) -> None:
    texts = ["put_the cube\non the star ", "Put the cube on the red shape"]
    state = np.array([[-1.2, -1, -0.999, 0, 0.5, 0.99999, 1, 1.3], np.linspace(-1, 1, 8)], np.float32)
    transition = {
        TransitionKey.OBSERVATION: {"observation.state": torch.from_numpy(state)},
        TransitionKey.COMPLEMENTARY_DATA: {"task": texts},
    }
    tokenised = Pi0FastPrepareStateAndLanguageTokenizerProcessorStep()(transition)
    assert pi0_fast.prompts(texts, state) == tokenised[TransitionKey.COMPLEMENTARY_DATA]["task"]


def test_roles_name_the_instruction_the_digits_and_the_words_around_them(pi0_fast: Pi0Fast) -> None:
    tokens, mask = pi0_fast.tokenise(["put the cube on the star"])
    pieces = pi0_fast.tokenizer.convert_ids_to_tokens(tokens[0].tolist())
    labels = pi0_fast.text_labels(tokens[0].tolist(), mask[0].tolist())
    by_role = {role: [piece for piece, label in zip(pieces, labels, strict=True) if label == role]
               for role in ("language", "state", "special")}  # fmt: skip
    assert by_role["language"] == ["put", "the", "cube", "on", "the", "star"]
    assert by_role["state"] == list("128" * 8)
    assert by_role["special"] == ["<bos>", "task", ":", ",", "state", ":", ";", "\n"]


@pytest.mark.parametrize("left_out", [HEAD, EMBEDDING])
def test_head_and_embedding_may_be_stored_as_one(untrained: Pi0Fast, tmp_path: Path, left_out: str) -> None:
    shutil.copytree(untrained.folder, tmp_path, dirs_exist_ok=True)
    tensors = load_file(tmp_path / "model.safetensors")
    (stored_weight,) = {HEAD, EMBEDDING} - {left_out}
    del tensors[left_out]
    save_file(tensors, tmp_path / "model.safetensors")
    loaded = Pi0Fast.load(str(tmp_path)).network.state_dict()
    assert torch.equal(loaded[left_out], tensors[stored_weight])
