"""Base adapter of vision-language models with text answers: packing, prefill, decoding, taps, roles.

One stack has two streams, distinguished by position: `backbone` is the prompt without its last position, `answer`
the last one, whose logits choose the first token of the answer. Padding stands in front of every row.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import InstructionError
from probe_kit.hooks.contract.model import Prompt, Reading, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.contract.unembedding import Unembedding
from probe_kit.hooks.contract.views import IMAGE_ROLE, PADDING
from probe_kit.hooks.families.shared.decoder_tap import decoder_tap
from probe_kit.hooks.families.shared.network_loading import Loaded
from probe_kit.hooks.families.shared.prompt_kv import ALL_BUT_LAST, ALL_TOKENS, LAST
from probe_kit.hooks.families.shared.vlm.decoding import Prefill, SpeakingModel
from probe_kit.hooks.families.shared.vlm.loading import Recipe, load_vlm
from probe_kit.hooks.families.shared.vlm.text import Frame, FramedText, TokenPrompt
from probe_kit.hooks.verification.outputs import Produce
from probe_kit.models.packing import LeftPacked

ANSWER = "answer"
Pictures = list[NDArray[np.uint8]]


class VisionLanguageModel(SpeakingModel):
    """A loaded vision-language model. Subclasses say how it is spoken to and how a picture becomes positions.

    recipe: how its network is made of files. stream_tolerance: of activations in golden references, absolute.
    """

    family: ClassVar[str]
    recipe: ClassVar[Recipe]
    stream_tolerance: ClassVar[float] = 3e-5
    frame: ClassVar[Frame]
    picture_token: ClassVar[str | None] = None
    """What stands at the positions of a picture, if it is a token of the tokenizer."""
    marks: ClassVar[int] = 0
    """Positions at either end of a picture's that only say where it begins and ends."""
    sums: ClassVar[bool] = True
    """Whether a block's attention and MLP are all that is added to the stream."""

    def __init__(self, loaded: Loaded[Any], tokenizer: str | None = None, **settings: str) -> None:
        """settings: what else the numbers depend on, for the card."""
        self.loaded, self.network = loaded, loaded.network
        self._text_folder = loaded.folder if tokenizer is None else Path(tokenizer).expanduser()
        layers, width = len(self.language.layers) + 1, int(self.text_config.hidden_size)
        heads = int(self.text_config.num_attention_heads)
        self.streams = {
            "backbone": Stream("backbone", layers, width, sums=self.sums, heads=heads),
            ANSWER: Stream(ANSWER, layers, width, 1, part="action", sums=self.sums, heads=heads),
        }
        blocks, vision_width = self.vision_size
        self.further_streams = {
            "vision": Stream("vision", blocks + 1, vision_width, part="vision", quantities=("residual",))
        }
        self.role_names = {"backbone": (IMAGE_ROLE, "language", "special", PADDING), ANSWER: (ANSWER,)}
        options = {"frame": str(self.frame), "tokenizer": tokenizer or "the checkpoint's", **settings}
        self.card = loaded.card(self.family, options, tokenizer=tokenizer)

    @classmethod
    def load(
        cls,
        checkpoint: str | None = None,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        *,
        tokenizer: str | None = None,
        weights_seed: int = 0,
        **settings: str,
    ) -> Self:
        """Load a model of any size from a folder or hub id; see `load_vlm`.

        tokenizer: folder of another one. settings: further options of the family, for its constructor.
        """
        loaded = load_vlm(cls.recipe, checkpoint, device, dtype, random_weights, weights_seed)
        return cls(loaded, tokenizer, **settings)

    # -- what a family decides ---------------------------------------------------------------------------

    @property
    @abstractmethod
    def vision_size(self) -> tuple[int, int]:
        """Blocks and width of the vision tower."""

    @abstractmethod
    def vision_tap(self, layer: int) -> Tap:
        """Return the tap of the input of block `layer` of the vision tower; the last is the tower's output."""

    @abstractmethod
    def picture_ids(self, height: int, width: int) -> list[int]:
        """The ids at the positions of a picture of that size, `marks` at either end included."""

    @abstractmethod
    def picture_inputs(self, pictures: Pictures) -> dict[str, Tensor]:
        """Keywords of the network for a batch of (H, W, 3) uint8 pictures, on the model's device."""

    def positions(self, packed: LeftPacked, picture_inputs: dict[str, Tensor]) -> Tensor:
        """(…, B, T) int64 positions. picture_inputs: of `picture_inputs`; empty without pictures."""
        del picture_inputs
        return packed.positions()

    def other_inputs(self, packed: LeftPacked) -> dict[str, Tensor]:
        """Further keywords of the network, with or without pictures."""
        del packed
        return {}

    @property
    def language(self) -> Any:
        """The decoder."""
        return self.network.model.language_model

    @property
    def text_config(self) -> Any:
        """The language model's configuration."""
        return self.network.config.text_config

    @property
    def causal(self) -> Any:
        """The network with the head that puts out tokens."""
        return self.network

    @property
    def unembedding(self) -> Unembedding:
        """The decoder's final norm and head."""
        return Unembedding.of_decoder(("backbone", ANSWER), self.causal, self.language.norm)

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def text(self) -> FramedText:
        """The text side of the prompt. Raises CheckpointError naming the files that are missing."""
        text = FramedText.of(self._text_folder, self.frame, self.text_config, self.loaded.folder)
        if self.picture_token is not None:
            text.check_token(self.picture_token, int(self.network.config.image_token_id))
        return text

    def prompt(self, question: Prompt) -> TokenPrompt:
        """The whole prompt of a question. Raises InstructionError or ObservationError for what does not fit in."""
        ids = None
        if question.pictured:
            ids = self.picture_ids(*checked_picture(question.observation.image).shape[:2])
        prompt = self.text.prompt(question.text, question.begun, ids, self.marks)
        limit = int(self.text_config.max_position_embeddings)
        if len(prompt.ids) > limit:
            raise InstructionError(
                f"a prompt makes {len(prompt.ids)} positions; this model has {limit}. Shorten it, or show a "
                "smaller picture"
            )
        return prompt

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt, as it is without a picture."""
        return [self.text.prompt(instruction).ids for instruction in instructions]

    # -- answering ---------------------------------------------------------------------------------------

    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """One pass over all questions."""
        self.check([question.observation for question in questions])
        picture_inputs: dict[str, Tensor] = {}
        if self.shows_pictures(questions):
            picture_inputs = self.picture_inputs(
                [checked_picture(question.observation.image) for question in questions]
            )
        packed = self.packed([self.prompt(question) for question in questions])
        with torch.inference_mode():
            return Prefill.of(
                self.network,
                packed,
                self.positions(packed, picture_inputs),
                {**picture_inputs, **self.other_inputs(packed)},
            )

    def packed(self, prompts: Sequence[TokenPrompt]) -> LeftPacked:
        """Prompts as one batch on the model's device."""
        return LeftPacked.of([prompt.ids for prompt in prompts], self.text.padding, self.loaded.device)

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """One prefill; see the contract."""
        self.shows_pictures(questions)
        options = [
            [self.text.option(prompt, option) for option in question.options]
            for question in questions
            for prompt in [self.text.prompt(question.text, question.begun, [] if question.pictured else None)]
        ]
        prefill = self.prefill(questions)
        return Reading.of(prefill.logits.float().cpu().numpy(), options, prefill)

    @property
    def speaker(self) -> Any:
        """The network itself."""
        return self.network

    @property
    def ends(self) -> frozenset[int]:
        """Ids that end an answer."""
        return self.text.ends

    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to its end."""
        return self.text.decode(ids)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles of the observations' instructions as questions."""
        return self.asked_roles([Prompt(observation, observation.instruction) for observation in observations])

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """Everything around picture and question is `special`, how an answer has begun too."""
        self.shows_pictures(questions)
        rows = [_labels(self.prompt(question))[self._backbone_tokens] for question in questions]
        return {
            "backbone": Roles.padded(rows, front=True),
            ANSWER: [Roles.from_labels([ANSWER])] * len(rows),
        }

    def match_policies(self, matched: bool) -> None:
        """Policies that read the keys and values of a prompt have all of it in their backbone."""
        self.whole_prompt = matched

    @property
    def _backbone_tokens(self) -> slice:
        return ALL_TOKENS if self.whole_prompt else ALL_BUT_LAST

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or a block's output."""
        if self.stream_of(site).part == "vision":
            return self.vision_tap(site.layer)
        tokens = self._backbone_tokens if site.stream == "backbone" else LAST
        return decoder_tap(self.language.layers, self.language.norm, site, tokens=tokens)

    # -- verification ------------------------------------------------------------------------------------

    def further_outputs(self, first: Prompt, produced: Mapping[str, Produce]) -> dict[str, Produce]:
        """Quantities of a golden reference that only this family has, or has in another form.

        first: the first question. produced: how the quantities of every family are made.
        """
        del first, produced
        return {}


def _labels(prompt: TokenPrompt) -> list[str]:
    labels = ["language" if is_question else "special" for is_question in prompt.question]
    start, stop = prompt.picture
    labels[start:stop] = [IMAGE_ROLE] * (stop - start)
    return labels
