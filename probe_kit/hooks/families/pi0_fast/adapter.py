"""The adapter for pi0-FAST: actions as text, a number of tokens that the network decides.

Sequence: every camera's patches, then a prompt with the instruction and the state as digits: one bidirectional
block, whose last token begins the actions. Action tokens follow, each reading all before it, until one is the end.
Iteration k of the stream `action` is the position that chooses the k-th token. The first ones are captured; the
others are decoded and belong to no site.

Source: arXiv 2501.09747, through lerobot's `PI0FastPolicy`.
"""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import UsageError
from probe_kit.hooks.checkpoints.folders import inside_or_hub
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.contract.unembedding import Unembedding
from probe_kit.hooks.families.pi0_fast import CAPTURED, FAST
from probe_kit.hooks.families.pi0_fast.actions import FILES, ActionText, DecodedChunk, FastTokenizer
from probe_kit.hooks.families.shared.attention_weights import Note, of_decoder
from probe_kit.hooks.families.shared.lerobot.evaluation import Evaluation
from probe_kit.hooks.families.shared.lerobot.paligemma import PaliGemmaPolicy, sizes_file
from probe_kit.hooks.families.shared.lerobot.pipelines import CROP
from probe_kit.hooks.families.shared.lerobot.policy import MASK, TOKENS
from probe_kit.hooks.families.shared.lerobot.stacks import Stack, TokenStack, flow_stacks
from probe_kit.hooks.families.shared.lerobot.state_prompt import StatePrompt
from probe_kit.hooks.families.shared.prompt_kv import ALL_BUT_LAST, LAST, kept_prompt
from probe_kit.hooks.families.shared.sampling import chooser
from probe_kit.hooks.verification.outputs import Arrays, Produce, RecordedRun, numpy_of
from probe_kit.models.lerobot.pi0_fast import Pi0FastSize, TokenPrompt, build_pi0_fast, decode_tokens
from probe_kit.models.lerobot.pi0_keys import EMBEDDING, LM_HEAD, current_pi0_fast_keys


@dataclass(frozen=True)
class Decoding(Evaluation):
    """The decoding of action tokens. captured_tokens: those that are sites.

    temperature: 0 for the likeliest token; above, drawn by each row's seed; None for the checkpoint's. lowercase:
    the instruction in lower case, as openpi has it; lerobot keeps its case.
    """

    captured_tokens: int = CAPTURED
    temperature: float | None = None
    lowercase: bool = False


class Pi0Fast(StatePrompt, PaliGemmaPolicy):
    """A loaded pi0-FAST.

    problems: per row of the last inference, why its tokens are no whole chunk of actions; empty where they are.
    """

    family = "pi0-fast"
    config_type = "pi0_fast"
    choice = Decoding
    evaluation: Decoding
    known_steps = (CROP, "pi0_fast_prepare_state_tokenizer_processor_step", "action_tokenizer_processor")
    interventions = FAST
    # Its head puts out tokens, and is read.
    tied: ClassVar[Mapping[str, str]] = {EMBEDDING: LM_HEAD, LM_HEAD: EMBEDDING}

    acting_stream = "action"
    suffix_roles = ("action",)
    prompt_tokens = ALL_BUT_LAST

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        self.problems: list[tuple[str, ...]] = []
        super().__init__(network, folder, checkpoint)
        self.passages = network.model.paligemma_with_expert.prompt_kv
        self.prompt_kv: Stream | None = kept_prompt(self._decoder.config)

    @classmethod
    def build(cls, config: Any, folder: Path) -> nn.Module:
        """lerobot's policy at the size `dims.json` gives, or at the released size.

        Raises UsageError for a number of captured tokens that an inference cannot put out, and for a temperature.
        """
        captured, most = config.evaluation.captured_tokens, int(config.max_decoding_steps)
        if not 1 <= captured <= most:
            raise UsageError(f"captured_tokens is {captured}; expected 1 to {most}")
        chooser(config.evaluation.temperature or 0, ())
        sizes = sizes_file(folder)
        network: nn.Module = build_pi0_fast(config, None if sizes is None else Pi0FastSize.from_file(sizes))
        return network

    @classmethod
    def current_names(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Old layouts brought to today's."""
        return current_pi0_fast_keys(tensors)

    @property
    def temperature(self) -> float:
        """0 for the likeliest token."""
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
        """The FAST tokenizer."""
        return {"fast": inside_or_hub(self.folder, self.config.action_tokenizer_name, FILES)}

    @cached_property
    def action_text(self) -> ActionText:
        """The meaning of the network's tokens."""
        fast, checked = FastTokenizer.from_folder(self.parts()["fast"]), self.config.validate_action_token_prefix
        return ActionText.of(self.tokenizer, fast, self.config.fast_skip_tokens, checked)

    # -- acting ------------------------------------------------------------------------------------------

    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """The chunks in the tokens; a row whose tokens are no whole chunk is flagged, with a warning."""
        chunks = self.chunks(self.tokens(batch, seeds))
        self.problems = [chunk.problems for chunk in chunks]
        self.flagged = np.array([bool(row) for row in self.problems])
        if self.flagged.any():
            _warn_of_problems()
        return np.stack([chunk.values for chunk in chunks]).astype(np.float32)

    def tokens(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> Tensor:
        """(B, n) ids that the network puts out for a batch in lerobot's keys; one inference."""
        self.check_pictures(batch)
        text = self.action_text
        choose = chooser(self.temperature, seeds, top=None)
        with torch.inference_mode():
            pictures, masks = self.network._preprocess_images(batch)
            begin = int(self.tokenizer.bos_token_id)
            prompt = TokenPrompt(pictures, masks, batch[TOKENS], batch[MASK], begin, text.end)
            most = int(self.config.max_decoding_steps)
            return decode_tokens(self.network.model, prompt, self.evaluation.captured_tokens, most, choose)

    def chunks(self, ids: Tensor) -> list[DecodedChunk]:
        """The normalised chunk in every row of (B, n) ids.

        It has as many actions as the network was trained to put out. lerobot decodes as many as it executes, which
        is another transform where the two numbers differ.
        """
        dimensions = int(self.config.output_features["action"].shape[0])
        return [self.action_text.decode(row, self.config.chunk_size, dimensions) for row in ids.tolist()]

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Computed once more for the position that chooses a token."""
        return of_decoder(self._decoder.layers, note)

    # -- capture -----------------------------------------------------------------------------------------

    @property
    def _decoder(self) -> Any:
        return self.network.model.paligemma_with_expert.paligemma.model.language_model

    def _stacks(self) -> dict[str, Stack]:
        decoder = self._decoder
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        layers, norm, width = decoder.layers, decoder.norm, decoder.config.hidden_size
        return {
            "backbone": TokenStack(layers, norm, width, None, tokens=ALL_BUT_LAST),
            "action": TokenStack(layers, norm, width, self.evaluation.captured_tokens, tokens=LAST),
            "vision": flow_stacks(decoder, decoder, vision, 1)["vision"],
        }

    def suffix_labels(self) -> list[str]:
        """One position at every iteration."""
        return ["action"]

    @property
    def unembedding(self) -> Unembedding:
        """PaliGemma's final norm and head."""
        head = self.network.model.paligemma_with_expert.paligemma.lm_head
        return Unembedding(("backbone", "action"), _FinalNorm(self._decoder.norm), head)

    # -- verification ------------------------------------------------------------------------------------

    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """The chunks and their ids; nothing is drawn in a golden reference."""
        del recorded
        ids = self.tokens(batch, range(len(batch[TOKENS])))
        return {"actions": np.stack([chunk.values for chunk in self.chunks(ids)]), "tokens": numpy_of(ids)}

    def watched(self) -> dict[str, nn.Module]:
        """The logits."""
        return {"logits": self.network.model.paligemma_with_expert.paligemma.lm_head}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Prepared pictures, and the logits of the ids that are put out."""
        batch = dict(run.batch)
        return {
            "prep_images": lambda: numpy_of(torch.stack(self.network._preprocess_images(batch)[0])),
            "prefix_pad": lambda: self.recorded_padding(run.recorded),
            "logits": lambda: numpy_of(torch.stack([step[:, -1] for step in run.calls["logits"]])),
        }


class _FinalNorm(nn.Module):
    """lerobot's norm without the gate that it returns beside what is normed."""

    def __init__(self, norm: nn.Module) -> None:
        super().__init__()
        self.norm = norm

    def forward(self, residual: Tensor) -> Tensor:
        """(…, D)."""
        normed: Tensor = self.norm(residual)[0]
        return normed


def _warn_of_problems() -> None:
    """The same words at every step, so that a run says it once."""
    warnings.warn(
        "the model put out tokens that are no whole chunk of actions; `problems` of the policy says why. What is "
        "missing counts as zero before units are restored, and the step as flagged. Random weights do this; if "
        "trained ones do, prompt, tokenizers or max_decoding_steps are wrong",
        stacklevel=3,
    )
