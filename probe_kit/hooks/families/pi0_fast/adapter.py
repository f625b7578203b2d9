"""The adapter for pi0-FAST: actions as text, a number of tokens that the network decides.

Sequence: every camera's patches, then a prompt with the instruction and the state as digits: one bidirectional
block, whose last token begins the actions. Action tokens follow, each reading all before it, until one is the end.
Iteration k of the stream `action` is the position that chooses the k-th token. The first ones are captured; the
others are decoded and belong to no site.

lerobot's constructor loads two tokenizers, one of them with remote code. The network is built without both.
`decode_tokens` calls lerobot's modules as its `sample_actions_fast_kv_cache` does, and gives the same tokens. It
also draws each row by its own seed, and decodes at least as many tokens as are captured.

A chunk is transformed per dimension along time (discrete cosine transform), scaled and rounded. It is flattened,
the lowest frequency of every dimension first. Each coefficient is a character; byte pairs of that text are tokens.

Source: arXiv 2501.09747; decoding as in `UniversalActionProcessor`, which lerobot ships for MolmoAct2.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import numpy as np
import torch
from lerobot.policies.common.vla_utils import prepare_attention_masks_4d
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig
from lerobot.policies.pi0_fast.modeling_pi0_fast import PI0FastPolicy
from numpy.typing import NDArray
from scipy.fft import idct  # type: ignore[import-untyped]
from tokenizers import Tokenizer
from torch import Tensor, nn

from probe_kit._system.bounded_files import load_json
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.model import Unembedding
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.families.pi0_fast import CAPTURED, FAST
from probe_kit.hooks.families.shared.kinds import Evaluation
from probe_kit.hooks.families.shared.lerobot.flow import GatelessNorm, PaliGemmaPolicy, StatePrompt, sizes_file
from probe_kit.hooks.families.shared.lerobot.packing import MASK, TOKENS
from probe_kit.hooks.families.shared.lerobot.paligemma import (
    EMBEDDING,
    LM_HEAD,
    PaliGemmaSize,
    build_resized,
    current_keys,
)
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP
from probe_kit.hooks.families.shared.taps import (
    ALL_BUT_LAST,
    LAST,
    Note,
    Stack,
    decoder_attention,
    flow_stacks,
    kept_prompt,
    token_stack,
)
from probe_kit.hooks.families.shared.token_decoder import chooser
from probe_kit.hooks.outputs import Arrays, Produce, RecordedRun, numpy_of
from probe_kit.models.building import replace_attributes
from probe_kit.models.decoding import PromptKV

FILES = ("tokenizer.json", "processor_config.json")
_BROKEN = "\ufffd"
"""The character that stands for bytes that make no character."""


@dataclass(frozen=True)
class DecodedChunk:
    """The actions in the tokens of one row.

    Attributes:
        values: (H, D) float64, normalised.
        problems: The reasons why the tokens are no whole chunk; empty where they are.
    """

    values: NDArray[np.float64]
    problems: tuple[str, ...]


@dataclass(frozen=True)
class FastTokenizer:
    """The tokenizer of FAST.

    Attributes:
        pieces: The tokenizer of byte pairs.
        scale: Coefficients per unit.
        least: The coefficient of chr(0).
    """

    pieces: Any
    scale: float
    least: int

    @classmethod
    def from_folder(cls, folder: Path) -> "FastTokenizer":
        """Read `tokenizer.json` and `processor_config.json`.

        Raises:
            CheckpointError: For missing files, and for files that cannot be read.
        """
        lacking = [name for name in FILES if not (folder / name).is_file()]
        if lacking:
            raise CheckpointError(
                f"{folder} is no FAST tokenizer: it has no {' and no '.join(lacking)}. Download it again"
            )
        again = "Download it again"
        with while_reading(folder / FILES[1], advice=again):
            values = load_json(folder / FILES[1])
            scale, least = float(values["scale"]), int(values["min_token"])
        with while_reading(folder / FILES[0], advice=again):
            pieces = Tokenizer.from_file(str(folder / FILES[0]))
        if not scale > 0:
            raise CheckpointError(f"{folder / FILES[1]} has scale {scale}; expected a positive number")
        return cls(pieces, scale, least)

    @property
    def size(self) -> int:
        """The number of its tokens."""
        return int(self.pieces.get_vocab_size())

    def decode(self, ids: Sequence[int], horizon: int, dimensions: int) -> DecodedChunk:
        """The chunk (horizon, dimensions) of its ids, decoded as in lerobot's relaxed decoding.

        Ids that it does not have and bytes that make no character are left out. Missing coefficients are zero, and
        surplus ones are cut. Each is a problem: lerobot says so only in its log.
        """
        problems = []
        fast_ids = [number for number in ids if 0 <= number < self.size]
        if len(fast_ids) < len(ids):
            problems.append(f"{len(ids) - len(fast_ids)} of {len(ids)} tokens name no FAST token")
        text = self.pieces.decode(fast_ids, skip_special_tokens=False)
        if broken := text.count(_BROKEN):
            problems.append(f"the tokens break {broken} characters apart")
        coefficients = (
            np.array([ord(character) for character in text if character != _BROKEN], np.int64) + self.least
        )
        count = horizon * dimensions
        if len(coefficients) != count:
            problems.append(f"{len(coefficients)} coefficients; a chunk has {horizon} x {dimensions}")
        filled = np.zeros(count)
        filled[: len(coefficients)] = coefficients[:count]
        values = idct(filled.reshape(horizon, dimensions) / self.scale, axis=0, norm="ortho")
        return DecodedChunk(np.asarray(values), tuple(problems))


@dataclass(frozen=True)
class ActionText:
    """The place of FAST's tokens in the network's output: behind `begin`, before `end`.

    Attributes:
        fast: The tokenizer.
        last: The id of its token 0; the others lie below.
        begin: Ids of "Action: ".
        end: The id that ends a chunk.
        checked: Whether a row must begin with `begin`.
    """

    fast: FastTokenizer
    last: int
    begin: tuple[int, ...]
    end: int
    checked: bool = True

    @classmethod
    def of(cls, text: Any, fast: FastTokenizer, skipped: int, checked: bool) -> "ActionText":
        """Read PaliGemma's tokenizer.

        Args:
            text: PaliGemma's tokenizer.
            fast: FAST's tokenizer.
            skipped: Count of ids at the end of `text` that stay free.
            checked: Whether a row must begin with "Action: ".

        Raises:
            CheckpointError: If FAST's tokens do not fit into the ids.
        """
        last = int(text.vocab_size) - 1 - skipped
        if last - fast.size < 0:
            raise CheckpointError(
                f"the text tokenizer has {text.vocab_size} ids; {skipped} free ones and {fast.size} FAST tokens "
                "do not fit. Its files belong to another checkpoint"
            )
        begin = tuple(text.encode("Action: ", add_special_tokens=False))
        return cls(fast, last, begin, int(text.convert_tokens_to_ids("|")), checked)

    def ids(self, fast: Sequence[int]) -> list[int]:
        """Return the network's ids for FAST's tokens: "Action: ", the tokens, and the end."""
        return [*self.begin, *(self.last - number for number in fast), self.end]

    def decode(self, ids: Sequence[int], horizon: int, dimensions: int) -> DecodedChunk:
        """The chunk in one row of ids; another beginning and a missing end are problems too."""
        tokens, problems = list(ids), []
        if self.end in tokens:
            tokens = tokens[: tokens.index(self.end)]
        else:
            problems.append(f"no end of the actions in {len(tokens)} tokens")
        if self.checked and tuple(tokens[: len(self.begin)]) != self.begin:
            problems.append('the tokens do not begin with "Action: "')
        chunk = self.fast.decode(
            [self.last - number for number in self._without_begin(tokens)], horizon, dimensions
        )
        return DecodedChunk(chunk.values, (*problems, *chunk.problems))

    def _without_begin(self, ids: Sequence[int]) -> list[int]:
        """Leave out every "Action: ", as lerobot does it."""
        remaining, at, length = [], 0, len(self.begin)
        while at < len(ids):
            if tuple(ids[at : at + length]) == self.begin:
                at += length
            else:
                remaining.append(ids[at])
                at += 1
        return remaining


_NO_TOKENIZER = SimpleNamespace(from_pretrained=lambda *_, **__: None)


# -- the network ----------------------------------------------------------------------------------------------


def build_pi0_fast(config: PI0FastConfig, size: PaliGemmaSize | None = None, device: str = "cpu") -> PI0FastPolicy:
    """Build a `PI0FastPolicy` without tokenizers; see `build_resized`."""
    with replace_attributes(modeling_pi0_fast, {"AutoProcessor": _NO_TOKENIZER, "AutoTokenizer": _NO_TOKENIZER}):
        policy = build_resized(PI0FastPolicy, config, size, device)
    joint: Any = policy.model.paligemma_with_expert
    joint.prompt_kv = PromptKV(len(joint.paligemma.model.language_model.layers))
    return cast(PI0FastPolicy, policy)


def full_size_pi0_fast() -> PI0FastPolicy:
    """Build the released size, on the meta device."""
    return build_pi0_fast(PI0FastConfig(device="cpu"), device="meta")


def decode_tokens(
    model: Any,
    pictures: tuple[list[Tensor], list[Tensor]],
    text: tuple[Tensor, Tensor],
    bounds: tuple[int, int],
    least: int,
    most: int,
    choose: Callable[[Tensor], Tensor],
) -> Tensor:
    """Return ids (B, n) of `least` to `most` tokens: until every row has put out the end.

    A row that has ended is decoded with the others, so that no row depends on another one. What it puts out behind
    its end means nothing.

    Args:
        model: Lerobot's `PI0FastPytorch`.
        pictures: (B, 3, H, W) in [-1, 1], and (B,) masks, of every camera.
        text: Tokens and mask of the prompts, (B, T).
        bounds: Ids that begin and end the actions.
        least: The smallest number of tokens.
        most: The largest number of tokens.
        choose: Gives (B,) ids of logits (B, V).
    """
    joint = model.paligemma_with_expert
    rows, device = len(text[0]), text[0].device
    always = torch.ones((rows, 1), dtype=torch.bool, device=device)
    begin = torch.full((rows, 1), bounds[0], dtype=torch.long, device=device)
    tokens, mask = torch.cat([text[0], begin], dim=1), torch.cat([text[1], always], dim=1)
    entering, valid, attends, _, _ = model.embed_prefix_fast(*pictures, tokens, mask)
    entering = entering.to(_dtype(joint, entering))
    places, past = torch.cumsum(valid, dim=1) - 1, None
    ids: list[Tensor] = []
    ended = torch.zeros(rows, dtype=torch.bool, device=device)
    while True:
        (states, _), past = joint.forward(
            attention_mask=prepare_attention_masks_4d(attends, dtype=entering.dtype),
            position_ids=places,
            past_key_values=past,
            inputs_embeds=[entering, None],
            use_cache=True,
            adarms_cond=[None, None],
        )
        if not ids:  # what follows reads what is kept of the prompt
            joint.prompt_kv(past.layers)
        ids.append(choose(joint.paligemma.lm_head(states[:, -1:])[:, -1]))
        ended |= ids[-1] == bounds[1]
        if len(ids) >= most or (len(ids) >= least and bool(ended.all())):
            return torch.stack(ids, dim=1)
        entering = joint.embed_language_tokens(ids[-1][:, None])
        entering = entering.to(_dtype(joint, entering))
        valid = torch.cat([valid, always], dim=1)
        places, attends = valid.sum(dim=1, keepdim=True) - 1, valid[:, None]


def _dtype(joint: Any, entering: Tensor) -> torch.dtype:
    """Return the dtype in which lerobot computes: bfloat16 where the attention's weights are."""
    stored: torch.dtype = joint.paligemma.model.language_model.layers[0].self_attn.q_proj.weight.dtype
    return torch.bfloat16 if stored == torch.bfloat16 else entering.dtype


# -- the adapter ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Decoding(Evaluation):
    """The decoding of action tokens; see the options of its family."""

    captured_tokens: int = CAPTURED
    temperature: float | None = None
    lowercase: bool = False


class Pi0Fast(StatePrompt, PaliGemmaPolicy):
    """A loaded pi0-FAST.

    `problems` holds per row of the last inference why its tokens are no whole chunk of actions; empty where they
    are.
    """

    family = "pi0-fast"
    config_type = "pi0_fast"
    choice = Decoding
    evaluation: Decoding
    known_steps = (CROP, "pi0_fast_prepare_state_tokenizer_processor_step", "action_tokenizer_processor")
    interventions = FAST
    # Its head puts out tokens, and is read.
    tied: ClassVar[Mapping[str, str]] = {EMBEDDING: LM_HEAD, LM_HEAD: EMBEDDING}
    current_names = current_keys

    acting_stream = "action"
    prompt_tokens = ALL_BUT_LAST

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        self.problems: list[tuple[str, ...]] = []
        super().__init__(network, folder, checkpoint)
        self.passages = network.model.paligemma_with_expert.prompt_kv
        self.prompt_kv: Stream | None = kept_prompt(self._decoder.config)

    @classmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build lerobot's policy at the size `dims.json` gives, or at the released size.

        Raises:
            UsageError: For a number of captured tokens that an inference cannot put out, and for a temperature.
        """
        captured, most = config.evaluation.captured_tokens, int(config.max_decoding_steps)
        if not 1 <= captured <= most:
            raise UsageError(f"captured_tokens is {captured}; expected 1 to {most}")
        chooser(config.evaluation.temperature or 0, ())
        sizes = sizes_file(folder)
        return build_pi0_fast(config, None if sizes is None else PaliGemmaSize.from_file(sizes))

    @property
    def temperature(self) -> float:
        """The temperature of the draw; 0 for the likeliest token."""
        requested = self.evaluation.temperature
        return float(self.config.temperature if requested is None else requested)

    def further_settings(self) -> dict[str, str]:
        """The settings of instruction and decoding."""
        return {
            "captured_tokens": str(self.evaluation.captured_tokens),
            "lowercase": str(self.evaluation.lowercase),
            "temperature": repr(self.temperature),
        }

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """Return prompts as lerobot words them, in lower case where that is chosen."""
        return super().prompts(
            [text.lower() if self.evaluation.lowercase else text for text in instructions], state
        )

    def _notes(self) -> tuple[str, ...]:
        most, chunk, executed = (
            int(getattr(self.config, name)) for name in ("max_decoding_steps", "chunk_size", "n_action_steps")
        )
        other = (
            f"decodes the trained chunk of {chunk} actions; lerobot decodes {executed}, which is another transform"
        )
        return (
            *super()._notes(),
            f"of up to {most} action tokens the first {self.evaluation.captured_tokens} are captured",
            *((other,) if executed != chunk else ()),
            "the instruction is in lower case, as openpi has it; lerobot keeps its case"
            if self.evaluation.lowercase
            else "the instruction keeps its case, as in lerobot; openpi writes lower case (-M lowercase=true)",
        )

    def parts(self) -> dict[str, Path]:
        """Return the folder of the FAST tokenizer."""
        return {"fast": inside_or_hub(self.folder, self.config.action_tokenizer_name, FILES)}

    @cached_property
    def action_text(self) -> ActionText:
        """The meaning of the network's tokens."""
        fast, checked = FastTokenizer.from_folder(self.parts()["fast"]), self.config.validate_action_token_prefix
        return ActionText.of(self.tokenizer, fast, self.config.fast_skip_tokens, checked)

    # -- acting ------------------------------------------------------------------------------------------

    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return the chunks in the tokens; a row whose tokens are no whole chunk is flagged, with a warning."""
        chunks = self.chunks(self.tokens(batch, seeds))
        self.problems = [chunk.problems for chunk in chunks]
        self.flagged = np.array([bool(row) for row in self.problems])
        if self.flagged.any():
            _warn_of_problems()
        return np.stack([chunk.values for chunk in chunks]).astype(np.float32)

    def tokens(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> Tensor:
        """Return ids (B, n) that the network puts out for a batch in lerobot's keys; one inference."""
        self.check_pictures(batch)
        bounds = int(self.tokenizer.bos_token_id), self.action_text.end
        least, most = self.evaluation.captured_tokens, int(self.config.max_decoding_steps)
        choose = chooser(self.temperature, seeds, top=None)
        with torch.inference_mode():
            pictures, text = self.network._preprocess_images(batch), (batch[TOKENS], batch[MASK])
            return decode_tokens(self.network.model, pictures, text, bounds, least, most, choose)

    def chunks(self, ids: Tensor) -> list[DecodedChunk]:
        """Return the normalised chunk in every row of (B, n) ids.

        It has as many actions as the network was trained to put out. lerobot decodes as many as it executes, which
        is another transform where the two numbers differ.
        """
        dimensions = int(self.config.output_features["action"].shape[0])
        return [self.action_text.decode(row, self.config.chunk_size, dimensions) for row in ids.tolist()]

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record attention that is computed once more for the position that chooses a token."""
        return decoder_attention(self._decoder.layers, note)

    # -- capture -----------------------------------------------------------------------------------------

    @property
    def _decoder(self) -> Any:
        return self.network.model.paligemma_with_expert.paligemma.model.language_model

    def _stacks(self) -> dict[str, Stack]:
        decoder = self._decoder
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        layers, norm, width = decoder.layers, decoder.norm, decoder.config.hidden_size
        return {
            "backbone": token_stack(layers, norm, width, None, tokens=ALL_BUT_LAST),
            "action": token_stack(layers, norm, width, self.evaluation.captured_tokens, tokens=LAST),
            "vision": flow_stacks(decoder, decoder, vision, 1)["vision"],
        }

    def suffix_labels(self) -> list[str]:
        """Return the label of one position, which is the same at every iteration."""
        return ["action"]

    @property
    def unembedding(self) -> Unembedding:
        """The final norm and head of PaliGemma."""
        head = self.network.model.paligemma_with_expert.paligemma.lm_head
        return Unembedding(("backbone", "action"), GatelessNorm(self._decoder.norm), head)

    # -- verification ------------------------------------------------------------------------------------

    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """Return the chunks and their ids; nothing is drawn in a golden reference."""
        del recorded
        ids = self.tokens(batch, range(len(batch[TOKENS])))
        return {"actions": np.stack([chunk.values for chunk in self.chunks(ids)]), "tokens": numpy_of(ids)}

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the module of the logits."""
        return {"logits": self.network.model.paligemma_with_expert.paligemma.lm_head}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return prepared pictures, and the logits of the ids that are put out."""
        batch = dict(run.batch)
        return {
            "prep_images": lambda: numpy_of(torch.stack(self.network._preprocess_images(batch)[0])),
            "prefix_pad": lambda: self.recorded_padding(run.recorded),
            "logits": lambda: numpy_of(torch.stack([step[:, -1] for step in run.calls["logits"]])),
        }


def _warn_of_problems() -> None:
    """Warn in the same words at every step, so that a run says it once."""
    warnings.warn(
        "the model put out tokens that are no whole chunk of actions; `problems` of the policy says why. What is "
        "missing counts as zero before units are restored, and the step as flagged. Random weights do this; if "
        "trained ones do, prompt, tokenizers or max_decoding_steps are wrong",
        stacklevel=3,
    )
