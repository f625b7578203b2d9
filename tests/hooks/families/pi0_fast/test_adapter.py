"""pi0-FAST keeps the contract, puts out lerobot's tokens, and says when they are no chunk."""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.policies.pi0_fast.processor_pi0_fast import Pi0FastPrepareStateAndLanguageTokenizerProcessorStep
from safetensors.torch import load_file, save_file

from probe_kit.errors import UsageError
from probe_kit.hooks import Observation, capture
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.pi0_fast import adapter as network
from probe_kit.hooks.families.pi0_fast.adapter import Pi0Fast
from tests.support.pi0_fast_checkpoints import HEAD, INSTRUCTIONS, TRAINED, write_pi0_fast

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
def seen(pi0_fast: Pi0Fast) -> list[Observation]:
    return examples_for(pi0_fast, *INSTRUCTIONS)


def test_whole_chunks_are_acted_on_without_a_flag(pi0_fast: Pi0Fast, seen: list[Observation]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        actions = pi0_fast.act(seen, [0, 0])
    assert pi0_fast.flagged is not None
    assert not pi0_fast.flagged.any()
    wanted = pi0_fast.action_units.restore(TRAINED)
    assert np.abs(actions - wanted).max() <= 0.1 * np.abs(pi0_fast.action_units.slope(7)).max()


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_tokens_are_those_of_lerobots_sampling(untrained: Pi0Fast, seen: list[Observation], dtype: str) -> None:
    fast = untrained if dtype == "float32" else Pi0Fast.load(str(untrained.folder), dtype=dtype)
    batch, policy = fast.batch(seen), fast.network
    ours = fast.tokens(batch, [0, 0])
    policy.model._paligemma_tokenizer = fast.tokenizer
    pictures, masks = policy._preprocess_images(batch)
    text = (batch["observation.language.tokens"], batch["observation.language.attention_mask"])
    with torch.inference_mode():
        theirs = policy.model.sample_actions_fast_kv_cache(pictures, masks, *text, ours.shape[1])
    assert torch.equal(ours, theirs)
    assert ours.unique().numel() > 5


def test_the_instruction_keeps_its_case_as_in_lerobot_or_loses_it_as_in_openpi(
    folder: Path, pi0_fast: Pi0Fast, seen: list[Observation]
) -> None:
    lower = Pi0Fast.load(str(folder), lowercase=True)
    text, state = [seen[0].instruction.title()], np.zeros((1, 7), np.float32)
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
    notes = [Pi0Fast.load(str(place)).card.notes for place in (folder, tmp_path)]
    assert [any("lerobot decodes 2" in note for note in one) for one in notes] == [False, True]


def test_a_chunk_that_does_not_end_is_flagged_and_warned_of(folder: Path, seen: list[Observation]) -> None:
    cut = Pi0Fast.load(str(folder))
    cut.config.max_decoding_steps = 12
    with pytest.warns(UserWarning, match="no whole chunk of actions"):
        actions = cut.act(seen, [0, 0])
    assert all("no end of the actions in 12 tokens" in row for row in cut.problems)
    assert cut.flagged is not None
    assert cut.flagged.all()
    assert np.isfinite(actions).all()


def test_a_row_that_has_ended_does_not_flag_for_the_tokens_behind_its_end(
    pi0_fast: Pi0Fast, seen: list[Observation]
) -> None:
    """One row ends before the other, and is decoded until that one ends."""
    ids, end = pi0_fast.tokens(pi0_fast.batch(seen), [0, 0]), pi0_fast.action_text.end
    ends = (ids == end).int().argmax(dim=1)
    assert ends[0] != ends[1]
    assert ids.shape[1] == ends.max() + 1


def test_more_tokens_are_captured_than_a_row_needs(folder: Path, seen: list[Observation]) -> None:
    policy = Pi0Fast.load(str(folder), captured_tokens=23)
    with capture(policy, policy.streams["action"].sites()) as cache:
        policy.act(seen, [0, 0])
    assert len(cache) == 23 * policy.streams["action"].layers
    assert policy.flagged is not None
    assert not policy.flagged.any()


@pytest.mark.parametrize("captured", [0, 25])
def test_a_number_of_captured_tokens_that_never_come_is_refused(folder: Path, captured: int) -> None:
    with pytest.raises(UsageError, match="expected 1 to 24"):
        Pi0Fast.load(str(folder), captured_tokens=captured)


def test_drawn_tokens_come_from_the_rows_own_seed(folder: Path, seen: list[Observation]) -> None:
    policy = Pi0Fast.load(str(folder), temperature=3.0)
    batch = policy.batch([seen[0], seen[0], seen[1]])
    ids = policy.tokens(batch, [1, 2, 1])
    assert not torch.equal(ids[0], ids[1])
    alone = policy.tokens(policy.batch([seen[0]]), [2])[0]
    shared = min(len(alone), ids.shape[1])
    assert torch.equal(ids[1, :shared], alone[:shared])


def test_half_precision_acts_as_captured_and_puts_out_whole_chunks(folder: Path, seen: list[Observation]) -> None:
    policy = Pi0Fast.load(str(folder), dtype="bfloat16")
    assert policy.card.dtype == "bfloat16"
    plain = policy.act(seen, [0, 0])
    with capture(policy, policy.sites()) as cache:
        np.testing.assert_array_equal(policy.act(seen, [0, 0]), plain)
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
    asked = Pi0FastPrepareStateAndLanguageTokenizerProcessorStep()(transition)
    assert pi0_fast.prompts(texts, state) == asked[TransitionKey.COMPLEMENTARY_DATA]["task"]


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
    (kept,) = {HEAD, EMBEDDING} - {left_out}
    del tensors[left_out]
    save_file(tensors, tmp_path / "model.safetensors")
    loaded = Pi0Fast.load(str(tmp_path)).network.state_dict()
    assert torch.equal(loaded[left_out], tensors[kept])


def test_the_released_size_has_the_tensors_of_lerobots_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the meta device; lerobot's tokenizers are on the hub, and have no parameter."""
    for name in ("AutoProcessor", "AutoTokenizer"):
        monkeypatch.setattr(modeling_pi0_fast, name, network._NO_TOKENIZER)
    ours = network.full_size_pi0_fast().state_dict()
    config = PI0FastConfig(device="cpu")
    config.device = "meta"
    with torch.device("meta"):
        lerobots = modeling_pi0_fast.PI0FastPolicy(config).state_dict()
    assert {name: tensor.shape for name, tensor in ours.items()} == {
        name: tensor.shape for name, tensor in lerobots.items()
    }
