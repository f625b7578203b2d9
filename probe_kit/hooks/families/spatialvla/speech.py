"""SpatialVLA's prompt: image placeholders, the instruction as in training, a new line."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.families.prismatic.tokenizer import BYTES, TextTokenizer, find_tokenizer
from probe_kit.models.spatialvla import SpatialVLAConfig

SLOT = "{instruction}"
PROMPTS = {"bare": SLOT, "question": f"What action should the robot take to {SLOT}?"}
"""What training and the released evaluation say, and what the model's page shows."""
_END = "\n"


@dataclass(frozen=True)
class Speech:
    """The way from an instruction to ids.

    template: with a place for the instruction. lowercase: as in training; the released evaluation does not.
    tokenizer_choice: None for the checkpoint's, a folder, or `bytes`.
    """

    config: SpatialVLAConfig
    folder: Path
    template: str
    lowercase: bool
    tokenizer_choice: str | None

    @classmethod
    def of(
        cls, config: SpatialVLAConfig, folder: Path, prompt: str | None, lowercase: bool, tokenizer: str | None
    ) -> "Speech":
        """Choose a prompt by name or template. Raises UsageError for one without a place for the instruction."""
        name = prompt or "bare"
        template = PROMPTS.get(name, name)
        if SLOT not in template:
            raise UsageError(f"prompt {name!r} is neither one of {', '.join(PROMPTS)} nor a template with {SLOT}")
        return cls(config, folder, template, lowercase, tokenizer)

    @cached_property
    def tokenizer(self) -> TextTokenizer:
        """Raises CheckpointError naming files that are missing, or ids that are not this model's."""
        config = self.config
        tokenizer = find_tokenizer([self.folder], self.tokenizer_choice, config.beginning, config.image_token)
        if self.tokenizer_choice != BYTES:
            for token, expected in (("<image>", config.image_token), ("<ACTION00000>", config.first_action)):
                if (ids := tokenizer.encode(token)[1:]) != [expected]:
                    raise CheckpointError(
                        f"the tokenizer reads {token} as {ids}; the model expects {expected}. It belongs to "
                        "another checkpoint: take the tokenizer files from the model's own page"
                    )
        return tokenizer

    def prompt(self, instruction: str) -> list[int]:
        """Ids of the whole prompt: the picture's places, beginning of sequence, text, new line.

        Raises InstructionError for text that the tokenizer reads as a picture or an action, or that takes the new
        line into itself: the model chooses its action there.
        """
        text = self.template.replace(SLOT, instruction.lower() if self.lowercase else instruction)
        ids = self.tokenizer.encode(text + _END)
        if max(ids) >= self.config.image_token:
            raise InstructionError(
                f"{text!r} holds a token that stands for a picture or an action; say it in words"
            )
        if ids[-1:] != self.tokenizer.encode(_END)[-1:]:
            raise InstructionError(
                f"the end of {text!r} merges with the new line behind it; leave out white space there"
            )
        return [self.config.image_token] * self.config.patches + ids
