"""Bases of lerobot's policies by kind: flows, packed prompts, PaliGemma's prompts, prompts that hold the state."""

import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional
from transformers import AutoTokenizer

from probe_kit.errors import CheckpointError
from probe_kit.hooks.capturing.capture_context import freeze_weights
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import PADDING, Site, kv_stream
from probe_kit.hooks.families.shared.kinds import FLOW, IMAGES
from probe_kit.hooks.families.shared.lerobot.paligemma import EMBEDDING, LM_HEAD
from probe_kit.hooks.families.shared.lerobot.pipelines import tokenizer_folder, tokenizer_name
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy, checked_steps
from probe_kit.hooks.families.shared.taps import attach_prompt_kv
from probe_kit.hooks.families.shared.text import token_texts
from probe_kit.hooks.families.shared.token_decoder import seeded_noise
from probe_kit.hooks.outputs import Arrays, Produce, RecordedRun, euler_path, numpy_of
from probe_kit.models.checkpoint_files import load_pretrained


class DenoisingPolicy(LerobotPolicy):
    """A lerobot policy that makes its chunk of actions from noise, in steps."""

    draws_noise = True
    acting_stream = "expert"

    @abstractmethod
    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return normalised actions (B, chunk, D) for a batch, with a graph where gradients are on.

        Args:
            batch: Observations in lerobot's keys.
            noise: (B, *noise_shape) float32.
        """

    @property
    def noise_shape(self) -> tuple[int, int]:
        """The shape of one row's noise: actions of a chunk, and the widest action."""
        return self.config.chunk_size, self.config.max_action_dim

    def infer(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return normalised actions (B, chunk, D), as `denoise` makes them, without a graph."""
        with torch.inference_mode():
            return self.denoise(batch, noise)

    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return the actions from the noise of the seeds."""
        chunk: NDArray[np.float32] = self.infer(batch, self.noise(seeds)).float().cpu().numpy()
        return chunk

    def differentiable(self, observations: Sequence[Observation], seeds: Sequence[int]) -> Tensor:
        """The actions of `act`, bit for bit, with a graph of every step; see the contract."""
        self.interventions.check("gradients", self.card.family)
        self.check_acting(observations, seeds)
        with freeze_weights(self.network):
            return self.restored(self.denoise(self.batch(observations), self.noise(seeds)))

    def noise(self, seeds: Sequence[int]) -> Tensor:
        """Return float32 noise (B, *noise_shape), a row per seed, the same on every device."""
        return seeded_noise(seeds, self.noise_shape, self.config.device)

    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """Return the actions from the recorded noise."""
        return {"actions": numpy_of(self.infer(batch, torch.from_numpy(recorded["in_noise"])))}


class LerobotFlow(DenoisingPolicy):
    """A lerobot flow-matching policy behind the Policy contract."""

    interventions = FLOW

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        super().__init__(network, folder, checkpoint)
        checked_steps(self.iterations, folder)
        # Before the streams are asked for: `prompt_kv` is one of them from now on.
        self.passages = attach_prompt_kv(self._joint, len(self.stacks["backbone"].layers))
        self.prompt_kv = kv_stream(len(self.passages.keys), self._kv_width)

    @property
    @abstractmethod
    def _joint(self) -> Any:
        """The module of backbone and expert in lerobot, whose first pass reads the prompt."""

    @property
    @abstractmethod
    def iterations(self) -> int:
        """The number of flow-matching steps per inference."""

    @property
    def _kv_width(self) -> int:
        """The number of heads times size of a head of the backbone's keys."""
        projection: Any = self.stacks["backbone"].layers[0]
        return int(projection.self_attn.k_proj.out_features)

    def denoise(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return the actions as the base does.

        Raises:
            ObservationError: For pictures that `check_pictures` refuses.
        """
        self.check_pictures(batch)
        with _with_graph(self.network.model):
            chunk: Tensor = without_decorator(self.network.predict_action_chunk)(batch, noise=noise)
        return chunk

    # -- verification ------------------------------------------------------------------------------------

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return the velocity, and the connector of a backbone that has one."""
        model = self.network.model
        connected = hasattr(model, "vlm_with_expert")
        connector = {"connector_out": model.vlm_with_expert.vlm.model.connector} if connected else {}
        return {"velocity": model.action_out_proj, **connector}

    def watched_inputs(self) -> dict[str, nn.Module]:
        """The first block of the backbone, for its position ids."""
        return {"backbone": self.stacks["backbone"].layers[0]}

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return prepared inputs, and the path of the flow.

        The path is made by Euler steps x ← x - v/S from the network's velocities.
        """
        steps, noise = self.iterations, torch.from_numpy(run.recorded["in_noise"])
        prepare = getattr(self.network, "_preprocess_images", None) or self.network.prepare_images

        def images(part: int) -> NDArray[Any]:
            return numpy_of(torch.stack(prepare(run.batch)[part]))

        def path() -> NDArray[Any]:
            return euler_path(noise, run.calls["velocity"], lambda velocity: -velocity / steps)

        produced: dict[str, Produce] = {
            "prefix_embs": lambda: numpy_of(run.activations[Site("backbone", 0)]),
            "prefix_pad": lambda: self.recorded_padding(run.recorded),
            "prep_images": lambda: images(0),
            "prep_image_masks": lambda: images(1),
            "prep_state": lambda: numpy_of(self.network.prepare_state(run.batch)),
            "x_t": path,
            "actions_padded": lambda: np.asarray(path()[-1]),
            "denoise_times": lambda: np.array([1 - step / steps for step in range(steps)], np.float32),
        }
        if run.calls["backbone"]:  # lerobot calls some backbones past their blocks
            produced["prefix_position_ids"] = lambda: numpy_of(run.calls["backbone"][0][1]["position_ids"])
        return produced


def without_decorator(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a bound method without the decorator that turns gradients off; itself if it has none."""
    inner = getattr(getattr(method, "__func__", method), "__wrapped__", None)
    return method if inner is None else partial(inner, getattr(method, "__self__", None))


@contextmanager
def _with_graph(model: Any) -> Iterator[None]:
    """Run the body with lerobot's sampling of a flow without the decorator of its own."""
    # An attribute of the instance hides the method of its class; `del` uncovers it again.
    model.sample_actions = without_decorator(model.sample_actions)
    try:
        yield
    finally:
        del model.sample_actions


# -- packed prompts -------------------------------------------------------------------------------------------

Tokens = list[tuple[int, str]]
"""The id and the role of every position of one prompt."""


class PackedRow(NamedTuple):
    """One packed observation.

    Attributes:
        inputs: The tensors that lerobot packs, with a batch axis of 1.
        labels: A role per position.
    """

    inputs: dict[str, Tensor]
    labels: list[str]

    @property
    def tokens(self) -> Tokens:
        """The ids of the prompt with their roles."""
        return list(zip(self.inputs["input_ids"][0].tolist(), self.labels, strict=True))


def chat_labels(
    ids: Sequence[int], pictures: Iterable[str], picture: int, words: tuple[int, int], state: int | None = None
) -> list[str]:
    """Return the role of every position of a chat: `language` between two marks, else `special`.

    Args:
        ids: The ids of the whole chat.
        pictures: The roles of the pictures, each a run of patches, in their order.
        picture: The id of a patch.
        words: The ids of the marks; the first counts where it stands last.
        state: The id of the state; None for a chat without one.
    """
    begin = len(ids) - ids[::-1].index(words[0])
    end, roles, role = ids.index(words[1], begin), iter(pictures), ""
    labels = []
    for index, token in enumerate(ids):
        if token == picture and (not index or ids[index - 1] != picture):
            role = next(roles)
        other = "language" if begin <= index < end else "state" if token == state else "special"
        labels.append(role if token == picture else other)
    return labels


class PackedPolicy(DenoisingPolicy):
    """A denoising policy that packs as lerobot's processors do; the packing says the role of every position."""

    masked_cameras = 0
    word_roles: ClassVar[tuple[str, ...]] = ("language", "special")
    """The roles of the tokens that stand for an instruction where two are compared."""

    @cached_property
    @abstractmethod
    def packing(self) -> Any:
        """The packing of lerobot; it has the `tokenizer`, and `row` and `batch` for `pack`."""

    def pack(
        self, observations: Sequence[Observation], state: NDArray[np.float32]
    ) -> tuple[dict[str, Tensor], list[Tokens]]:
        """Return the observations as the network reads them, and of each its prompt without the actions.

        Args:
            observations: The B rows of the batch.
            state: (B, numbers) as the network reads them.

        Raises:
            InstructionError: For a text that it cannot take in.
        """
        rows: list[PackedRow] = [
            self.packing.row(self.pictures_of(observation), observation.instruction, numbers)
            for observation, numbers in zip(observations, state, strict=True)
        ]
        return self.packing.batch(rows), [row.tokens for row in rows]

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of the packing."""
        return self.packing.tokenizer

    def pictures_of(self, observation: Observation) -> dict[str, NDArray[np.uint8]]:
        """The pictures (H, W, 3) of the shown cameras.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        return {camera: self.picture_of(camera, observation) for camera in self.shown_cameras}

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return a batch in lerobot's keys.

        Args:
            observations: The B rows of the batch.
            state: (B, numbers) as the network reads them; None for that of the observations.
        """
        inputs, _ = self.pack(observations, self.state(observations) if state is None else state)
        return {name: tensor.to(self.config.device) for name, tensor in inputs.items()}

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles from the packing itself; streams besides the acting one have the backbone's tokens."""
        state = self.read_state(observations)
        _, rows = self.pack(observations, self._no_state(len(observations)) if state is None else state)
        prompts = Roles.padded([[label for _, label in row] for row in rows])
        suffix = [Roles.from_labels(self.suffix_labels())] * len(rows)
        return {name: suffix if name == self.acting_stream else prompts for name in self.streams}

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each prompt, without pictures and without the state, which change at every inference."""
        height, width = self.config.image_features[f"{IMAGES}{self.cameras[0]}"].shape[-2:]
        blank, state = np.zeros((height, width, 3), np.uint8), np.zeros(ARM_NUMBERS, np.float32)
        cameras = dict.fromkeys(self.shown_cameras[1:], blank)
        observations = [Observation(blank, state, text, cameras=cameras) for text in instructions]
        rows = [self.pack([observation], self._no_state(1))[1][0] for observation in observations]
        return [tuple(number for number, role in row if role in self.word_roles) for row in rows]

    @classmethod
    def check_words(cls, checkpoint: str, instructions: Sequence[str], **options: Any) -> None:
        """Raise InstructionError as `pack` would, from configuration and tokenizer alone."""
        cls._text_reader(checkpoint, options).token_ids(instructions)

    def _no_state(self, rows: int) -> NDArray[np.float32]:
        return np.zeros((rows, self.state_numbers), np.float32)


# -- PaliGemma's prompts --------------------------------------------------------------------------------------

_TOKENIZER = "google/paligemma-3b-pt-224"
_TOKENIZER_FILES = ("tokenizer*", "special_tokens_map.json", "added_tokens.json", "config.json")
LEAST_BYTES = 1_000_000_000
"""The smallest size of the weights of a released size, which has 3 billion parameters or more."""


def _check_small_weights(folder: Path) -> None:
    """Raise CheckpointError for a small network that lost its `dims.json`.

    It would be built at full size, for minutes, before it is refused.
    """
    size = sum(file.stat().st_size for file in folder.glob("*.safetensors"))
    if 0 < size < LEAST_BYTES:
        raise CheckpointError(
            f"{folder} has {size / 1e6:,.1f} MB of weights and no dims.json; the released size has "
            "several GB. Put the dims.json beside its config.json, or download the checkpoint again"
        )


def sizes_file(folder: Path) -> Path | None:
    """The `dims.json` of a small checkpoint; None for one of the released size.

    Raises:
        CheckpointError: For a small one that lost it.
    """
    sizes = [parent / "dims.json" for parent in (folder, folder.parent) if (parent / "dims.json").is_file()]
    if not sizes:
        _check_small_weights(folder)
    return sizes[0] if sizes else None


class GatelessNorm(nn.Module):
    """The norm of lerobot without the gate that it returns beside what is normed."""

    def __init__(self, norm: nn.Module) -> None:
        super().__init__()
        self.norm = norm

    def forward(self, residual: Tensor) -> Tensor:
        """Return the normed residual (…, D)."""
        normed: Tensor = self.norm(residual)[0]
        return normed


class TiedHead(nn.Module):
    """The head of a language model whose weights are those of its embedding."""

    def __init__(self, embedding: nn.Embedding) -> None:
        super().__init__()
        self.embedding = embedding

    def forward(self, normed: Tensor) -> Tensor:
        """Return logits (…, V) of normed residuals (…, D)."""
        return functional.linear(normed, self.embedding.weight)


class PaliGemmaPolicy(LerobotPolicy):
    """A lerobot policy whose prompt is read by PaliGemma."""

    # pi0_base holds the embedding as `lm_head` alone.
    tied: ClassVar[Mapping[str, str]] = {EMBEDDING: LM_HEAD}

    @cached_property
    def tokenizer(self) -> Any:
        """The tokenizer of PaliGemma, from the checkpoint folder or the hub."""
        if (folder := self._tokenizer_folder()) is not None:
            return load_pretrained(AutoTokenizer, folder)
        repository = tokenizer_name(self.folder) or _TOKENIZER
        try:
            return load_pretrained(AutoTokenizer, checkpoint_folder(repository, _TOKENIZER_FILES))
        except (CheckpointError, OSError, ValueError) as error:
            gated = "gated " if repository == _TOKENIZER else ""
            raise CheckpointError(
                f"{self.folder} has no tokenizer.json and the {gated}{repository} cannot be fetched. Run "
                "`hf auth login`, or put its tokenizer.json and tokenizer_config.json into the checkpoint folder"
            ) from error

    def token_texts(self) -> tuple[str, ...]:
        """Return the text of every token by its id."""
        return token_texts(self.tokenizer.backend_tokenizer)

    def _tokenizer_folder(self) -> Path | None:
        if (saved := tokenizer_folder(self.folder)) is not None:
            return saved
        places = (self.folder, self.folder.parent / "tokenizer")
        return next((folder for folder in places if (folder / "tokenizer.json").is_file()), None)

    def side_files(self) -> dict[str, Path]:
        """Return the files of the base, and the sizes where they lie beside the folder."""
        files, sizes = super().side_files(), self.folder.parent / "dims.json"
        return {**({"dims.json": sizes} if sizes.is_file() else {}), **files}

    def parts(self) -> dict[str, Path]:
        """The tokenizer, where it lies beside the folder."""
        folder = self._tokenizer_folder()
        return {} if folder is None or folder == self.folder else {"tokenizer": folder}

    @property
    def masked_cameras(self) -> int:
        """The number of cameras that are not shown."""
        return len(self.config.image_features) - len(self.shown_cameras)

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """Return the labels of a row; cameras without a picture are masked and lie behind the shown ones."""
        images = [f"image.{camera}" for camera in self.shown_cameras for _ in range(self.tokens_per_camera)]
        return [*images, *[PADDING] * self.tokens_per_camera * self.masked_cameras, *language]

    def patch_order(self) -> NDArray[np.int64]:
        """Return a token per patch, row by row."""
        return np.arange(self.tokens_per_camera)

    @property
    def tokens_per_camera(self) -> int:
        """The number of patches of one picture."""
        vision = self.network.model.paligemma_with_expert.paligemma.model.vision_tower.vision_model
        return int(vision.embeddings.num_patches)


# -- prompts that hold the state ------------------------------------------------------------------------------

BINS = np.linspace(-1, 1, 256 + 1)[:-1]
"""The lower edges of the 256 bins of a normalised state, as lerobot's processor step of pi0.5 makes them."""
_PROMPT = re.compile(
    r"Task: ?(?P<language>.*), ?State: ?(?P<state>[-\d ]*);\s*(?:Action:\s*)?\Z", re.DOTALL | re.IGNORECASE
)
"""The prompt of pi0.5; its named parts are roles."""
_LEFT_OUT = (PADDING, "state")


def digits(state: NDArray[np.float32]) -> list[str]:
    """Return normalised numbers (B, numbers) as the numbers of their bins: 0 to 255, and -1 below the range."""
    return [" ".join(map(str, row)) for row in np.digitize(state, BINS) - 1]


def label_groups(pieces: Sequence[str], pattern: re.Pattern[str]) -> list[str]:
    """Return a label per piece of a text: the named group of `pattern` with characters in it, else `special`."""
    ends = np.cumsum([len(piece) for piece in pieces])
    labels = ["special"] * len(pieces)
    if (match := pattern.search("".join(pieces))) is None:
        return labels
    for role in pattern.groupindex:
        first, last = match.span(role)
        for position, (piece, end) in enumerate(zip(pieces, ends, strict=True)):
            if piece and end - len(piece) < last and end > first:
                labels[position] = role
    return labels


class StatePrompt(LerobotPolicy):
    """A lerobot policy that reads its state in its prompt."""

    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    prompt_end: ClassVar[str] = ""
    """The text behind the state."""

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """Return prompts as lerobot's processor steps of these policies word them."""
        tasks = [text.strip().replace("_", " ").replace("\n", " ") for text in instructions]
        return [
            f"Task: {task}, State: {state_digits};\n{self.prompt_end}"
            for task, state_digits in zip(tasks, digits(state), strict=True)
        ]

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """Return labels: `language` for the instruction, `state` for the digits, `special` for words around."""
        special = frozenset(self.tokenizer.all_special_ids)
        pieces = [
            "" if number in special or not is_text else piece.replace("\u2581", " ")
            for number, is_text, piece in zip(
                ids, valid, self.tokenizer.convert_ids_to_tokens(list(ids)), strict=True
            )
        ]
        labels = label_groups(pieces, _PROMPT)
        return [label if is_text else PADDING for label, is_text in zip(labels, valid, strict=True)]

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each prompt without padding and without the digits, which change at every inference."""
        tokens, mask = self.tokenise(instructions)
        rows = zip(tokens.tolist(), mask.tolist(), strict=True)
        return [
            tuple(
                number
                for number, label in zip(ids, self.text_labels(ids, valid), strict=True)
                if label not in _LEFT_OUT
            )
            for ids, valid in rows
        ]
