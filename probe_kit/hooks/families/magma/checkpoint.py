"""The files of a Magma checkpoint: loading, and the text side of its prompts."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from probe_kit._system.bounded_files import read_regular_text
from probe_kit.errors import CheckpointError, UsageError, WeightsError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE, chosen_dtype
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, read_weights
from probe_kit.hooks.families.magma.network import (
    UNUSED_WEIGHTS,
    MagmaConfig,
    MagmaNetwork,
    build_magma,
    chat_text,
    conversation,
    picture_question,
    shipped_statistics,
)
from probe_kit.hooks.families.shared.loading import DTYPES, Loaded, load_network
from probe_kit.hooks.families.shared.text import (
    TokenizerFile,
    TokenPrompt,
    first_behind,
    positions_of,
    token_ids_of,
    values_of,
)
from probe_kit.models.building import initialise
from probe_kit.models.checkpoint_files import STATISTICS_FILE, chosen_name, read_statistics, stored_statistics


@dataclass(frozen=True)
class ChatText(TokenizerFile):
    """The chat template of Magma: header tokens, image placeholder, question.

    Attributes:
        config: The configuration of the network.
        user_first: Whether the user's turn stands before the system's, as Act2Answer's release has it.
    """

    config: MagmaConfig
    user_first: bool = False

    @classmethod
    def of(cls, folder: Path, config: MagmaConfig, user_first: bool = False) -> "ChatText":
        """Read the tokenizer in `folder`.

        Raises:
            CheckpointError: For missing files and for a tokenizer of another model.
        """
        TokenizerFile(folder).check_present()
        text = cls(folder, config, user_first)
        text.check()
        return text

    @cached_property
    def _template(self) -> str | None:
        """The checkpoint's chat template in Jinja, None if it has none."""
        file = self.folder / "chat_template.jinja"
        stored = read_regular_text(file) if file.is_file() else self.settings.get("chat_template")
        if stored is not None and not isinstance(stored, str):
            raise CheckpointError(
                f"{self.folder} has {len(stored)} chat templates; expected one. Keep the one the model was "
                "trained with"
            )
        return stored

    @cached_property
    def _beginning(self) -> dict[str, str]:
        token = self.token_of("bos_token")
        return {"beginning": token} if token else {}

    def check(self) -> None:
        """Refuse a tokenizer that belongs to another model.

        Raises:
            CheckpointError: For such a tokenizer.
        """
        counts = self.vocabulary, self.config.base_vocabulary
        if counts[1] not in (None, counts[0]):
            raise CheckpointError(
                f"{self.file} has {counts[0]} ids before the added ones, config.json says {counts[1]} "
                "(tokenizer_vocab_size): every action would be decoded wrongly. Take the checkpoint's tokenizer"
            )
        self.check_vocabulary(int(self.config.text.vocab_size))

    @property
    def vocabulary(self) -> int:
        """The number of ids before the added tokens; the last of them name action bins."""
        return int(self.tokenizer.get_vocab_size(with_added_tokens=False))

    @cached_property
    def ends(self) -> frozenset[int]:
        """The ids that end the assistant's turn."""
        stored = values_of(self.folder / GENERATION_FILE).get("eos_token_id")
        return token_ids_of(self.config.text.eos_token_id, stored, self.tokenizer.token_to_id("<|eot_id|>"))

    def prompt(self, question: str, begun: str = "", pictured: bool = True) -> TokenPrompt:
        """The whole prompt of a question about one picture, or in words alone.

        Args:
            question: The text of the question.
            begun: The beginning of the answer, behind the header of the assistant's turn.
            pictured: Whether the picture is shown; False asks in words alone.

        Raises:
            InstructionError: For a question that holds a token of the frames.
        """
        self.check_marks(question + begun)
        before = picture_question("", self.config.image_start_end) if pictured else ""
        turn = before + question
        frames = chat_text(conversation(turn, self.user_first), self._template, **self._beginning)
        start, stop = self._question_span(turn, frames)
        start += len(before)
        encoding = self.tokenizer.encode(frames + begun)
        return TokenPrompt(frames + begun, tuple(encoding.ids), positions_of(encoding, start, stop))

    def _question_span(self, turn: str, frames: str) -> tuple[int, int]:
        """The beginning and end of the user's words in `frames`.

        Raises:
            CheckpointError: For a template that changes the words.
        """
        words = turn.strip()  # as templates do
        start = frames.find(words)
        if start < 0:
            raise CheckpointError(
                f"the chat template in {self.folder} changes the words of a turn: {words!r} is not in {frames!r}. "
                "Take the template the model was trained with"
            )
        return start, start + len(words)

    def option(self, question: str, begun: str, option: str, pictured: bool = True) -> int:
        """The first id of an option behind a prompt.

        Raises:
            UsageError: If it changes the prompt's own ids.
        """
        before, behind = (self.prompt(question, text, pictured).ids for text in (begun, begun + option))
        return first_behind(before, behind, option)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids up to the end of the turn, without special tokens."""
        return self.words(ids, self.ends)


# -- loading --------------------------------------------------------------------------------------------------

_BLOCK = re.compile(r"(?P<block>vision_tower\..*\.blocks\.\d+)\.(?P<name>gamma|weight)")


def load_checkpoint(
    checkpoint: str,
    device: str,
    dtype: str | None,
    random_weights: bool,
    *,
    weights_seed: int = 0,
    layer_scale: str | None = None,
) -> tuple[Loaded[MagmaNetwork], str]:
    """Load a folder or hub id; also return the name the file has for layer scales, `gamma` or `weight`.

    Args:
        checkpoint: Folder or hub id.
        device: Device in torch's spelling, such as `cuda:0`.
        dtype: float32 or bfloat16; None takes what the checkpoint says.
        random_weights: Whether the weights are drawn instead of read.
        weights_seed: Seed of random weights.
        layer_scale: `gamma` refuses a file that names them otherwise; None and `weight` accept both names.

    Raises:
        CheckpointError: For a folder that is not there, and for files that are missing or bad.
        WeightsError: For weights that are not exactly the network's, and for layer scales that were not trained.
        UsageError: For another dtype.
        MissingExtraError: Without a package that the network needs.
    """
    folder = checkpoint_folder(checkpoint)
    config = MagmaConfig.from_folder(folder)
    notes, stored_name = tuple[str, ...](), "gamma"

    def tensors_of(weights: Weights) -> dict[str, Tensor]:
        nonlocal notes, stored_name
        tensors, notes, stored_name = _with_layer_scales(weights, layer_scale)
        if unread := [name for name in UNUSED_WEIGHTS if tensors.pop(name, None) is not None]:
            notes += (f"{len(unread)} tensors of the contrastive head are in the file and never read",)
        return tensors

    loaded = load_network(
        partial(build_magma, config),
        lambda: read_weights(folder, unlisted=UNUSED_WEIGHTS),
        checkpoint,
        folder,
        device,
        chosen_dtype(dtype, config.dtype, DTYPES),
        random_weights,
        weights_seed,
        tensors_of=tensors_of,
        draw=_draw,
    )
    return replace(loaded, notes=(*loaded.notes, *notes)), layer_scale or stored_name


def _draw(network: MagmaNetwork, seed: int) -> None:
    initialise(network, seed)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if name.endswith(".gamma"):
                parameter.fill_(1)  # at timm's 1e-6 the blocks of the trunk would do nothing


def _with_layer_scales(
    weights: Weights, layer_scale: str | None
) -> tuple[dict[str, Tensor], tuple[str, ...], str]:
    """Return the tensors under the network's names, a note if some were stored as `.weight`, and the stored name.

    Loaders before transformers 5 rename every `gamma` to `weight`. The released file names them so; a file that
    such a loader saved later holds the initial constant, which is refused.

    Raises:
        WeightsError: For layer scales under a refused name, under both names, or as before training.
    """
    scales = {name: match for name in weights.tensors if (match := _BLOCK.fullmatch(name))}
    renamed = {name: match["block"] + ".gamma" for name, match in scales.items() if match["name"] == "weight"}
    if renamed and layer_scale == "gamma":
        raise WeightsError(
            f"weights in {weights.source} hold {len(renamed)} layer scales of the vision tower as .weight instead "
            f"of .gamma, such as {min(renamed)}. Leave -M layer_scale=gamma out to accept them"
        )
    if twice := sorted(set(renamed.values()) & set(weights.tensors)):
        raise WeightsError(
            f"damaged checkpoint: weights in {weights.source} hold {len(twice)} layer scales twice, as .gamma and "
            f"as .weight, such as {twice[0]}. Take the original files"
        )
    tensors = {renamed.get(name, name): tensor for name, tensor in weights.tensors.items()}
    if not weights.random:
        _check_trained(tensors, weights.source)
    if not renamed:
        return tensors, (), "gamma"
    return tensors, (f"{len(renamed)} layer scales taken from tensors stored as .weight",), "weight"


def _check_trained(tensors: Mapping[str, Tensor], source: str) -> None:
    """Raise WeightsError for a layer scale with one value in every feature, as before training."""
    scales = {name: tensor.float() for name, tensor in tensors.items() if _BLOCK.fullmatch(name)}
    constant = {name: float(scale[0]) for name, scale in scales.items() if bool((scale == scale[0]).all())}
    if constant:
        name, value = min(constant.items())
        raise WeightsError(
            f"damaged checkpoint: weights in {source} hold {len(constant)} layer scales of the vision tower with "
            f"one value in every feature, as before training, such as {name}: {value:.3g} in every feature. A "
            "loader that could not place the trained ones saved this file. Take the original files"
        )


PACKAGED = "the package (its magma_statistics.json says whence)"


def magma_statistics(folder: Path, file: str | None) -> tuple[Mapping[str, Any], str]:
    """The statistics of `file`, of the checkpoint, or of the package, and the name of their source.

    The released checkpoint has none: the evaluation client holds them.

    Raises:
        CheckpointError: For a bad file.
    """
    if file is not None:
        return read_statistics(Path(file).expanduser()), file
    return stored_statistics((folder,), shipped_statistics(), PACKAGED)


def magma_key(statistics: Mapping[str, Any], source: str, key: str | None) -> str:
    """The data set whose units the actions get.

    The packaged statistics are of one data set, with which a checkpoint without a file may have nothing to do.

    Raises:
        UsageError: Where it has to be chosen.
    """
    if key is None and source == PACKAGED:
        raise UsageError(
            f"the checkpoint has no {STATISTICS_FILE}: nothing says whose units its actions get. Put that file "
            f"into its folder, name one with -M statistics=FILE, or choose -M unnorm_key={', '.join(statistics)} "
            "of the package"
        )
    return chosen_name(statistics, key, "unnorm_key", source)
