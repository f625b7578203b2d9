"""FAST's tokens become the chunk they were made of, and what is no chunk is said."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from tokenizers import Tokenizer
from tokenizers.decoders import ByteLevel as Bytes
from tokenizers.models import BPE
from tokenizers.pre_tokenizers import ByteLevel

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.pi0_fast.adapter import ActionText, FastTokenizer
from tests.support.pi0_fast_checkpoints import ACTIONS, CHUNK, fast_processor, smooth_chunks


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
    wanted = theirs.decode(tokens, time_horizon=CHUNK, action_dim=ACTIONS)
    found = [fast.decode(row, CHUNK, ACTIONS) for row in tokens]
    assert 1 <= sum(bool(one.problems) for one in found) <= 20
    for ours, expected, chunk in zip(found, wanted, chunks, strict=True):
        if ours.problems:
            assert not expected.any()
            assert ours.values.any()
        else:
            np.testing.assert_array_equal(ours.values, expected)
            assert np.abs(ours.values - chunk).max() < np.sqrt(CHUNK) / fast.scale


def test_what_is_no_whole_chunk_is_a_problem_and_never_zeros_in_silence(fast: FastTokenizer) -> None:
    whole = encoded(fast, np.full((CHUNK, ACTIONS), 3))
    short, long = (encoded(fast, np.full((rows, ACTIONS), 3)) for rows in (CHUNK - 1, CHUNK + 1))
    assert fast.decode(whole, CHUNK, ACTIONS).problems == ()
    for ids, said in (
        (short, "21 coefficients; a chunk has 4 x 7"),
        (long, "35 coefficients; a chunk has 4 x 7"),
        ([*whole, -1, fast.size], f"2 of {len(whole) + 2} tokens name no FAST token"),
        ([], "0 coefficients; a chunk has 4 x 7"),
    ):
        chunk = fast.decode(ids, CHUNK, ACTIONS)
        assert said in chunk.problems
        assert chunk.values.shape == (CHUNK, ACTIONS)
        assert np.isfinite(chunk.values).all()
    np.testing.assert_array_equal(
        fast.decode(long, CHUNK, ACTIONS).values, fast.decode(whole, CHUNK, ACTIONS).values
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
