"""Base adapter of lerobot's policies: loading, batches, units, prompts, roles.

The `from_pretrained` of lerobot is never used: it returns partly or fully random models without an error.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import draccus  # the decoder of lerobot, which installs it
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, InstructionError, ObservationError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, SMALL_FILES, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, load_weights, read_weights
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.contract.model import Policy, Tap
from probe_kit.hooks.contract.observation import ARM_NUMBERS, Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import PADDING, Site
from probe_kit.hooks.families.shared.feature_names import names_misfit, names_of, read_names
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE, Evaluation, cameras_of
from probe_kit.hooks.families.shared.lerobot.normaliser import (
    Normaliser,
    from_buffers,
    read_buffers,
    read_normaliser,
)
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    CROP,
    NORMALISERS,
    POSTPROCESSOR,
    PREPROCESSOR,
    RELATIVE,
    TOKENIZER,
    Inert,
    adds_state,
    check_one_frame,
    check_steps,
    known_values,
    rename_map,
    text_length,
)
from probe_kit.hooks.families.shared.lerobot.window import PictureWindow, read_window
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.taps import ALL_TOKENS, Stack, kv_tap
from probe_kit.hooks.outputs import Arrays, Produce, RecordedRun
from probe_kit.models.building import WithoutFilling, initialise
from probe_kit.models.decoding import PromptKV

MOST_TOKENS = 1 << 16
"""The most tokens of a prompt: far beyond any policy, and no memory without end."""
TOKENS, MASK = "observation.language.tokens", "observation.language.attention_mask"
UNCOMPARED = ("IDENTITY", "EXCLUDED")
"""The modes of units without statistics: the state is read as it is, or not at all."""
_ACTION_NAMES = "action_feature_names"
_DIMENSIONS = 7
"""The count of numbers of the arm's actions."""
TEXT_FILES = (*SMALL_FILES, "policy_*.safetensors")
"""The files that packing and tokenising read: of the weights only those of lerobot's processors."""
_VISION = "vision"
"""The stream of a vision tower."""


class LerobotPolicy(Policy):
    """A lerobot policy behind the Policy contract; subclasses say how it packs its sequence and puts out actions.

    `cameras` are those that a picture can be given for; `shown_cameras` get one, in the configuration's order.
    """

    family: ClassVar[str]
    config_type: ClassVar[str]
    choice: ClassVar[type[Evaluation]] = Evaluation
    """The options of its loader."""
    evaluation: Evaluation
    unread: ClassVar[tuple[str, ...]] = ()
    """Parameters that inference never reads and a file may lack."""
    tied: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """The tied tensor that is read in its place, by the name of a tensor that a file may lack."""
    current_names: ClassVar[Callable[[Mapping[str, Tensor]], dict[str, Tensor]]] = dict
    """Maps a file's tensors to those under the names that the network has."""
    newer_fields: ClassVar[Inert] = {}
    """The fields of its configuration in a newer lerobot than the installed one."""
    takes_unread: ClassVar[bool] = False
    """Whether users can say with -M unread which fields change nothing."""
    known_steps: ClassVar[tuple[str, ...] | None] = (CROP,)
    """Steps of lerobot's processors that only this family has; None where it reads the pipelines itself."""
    other_roles: ClassVar[tuple[str, ...]] = ("language", "state", "special")
    """The roles of positions of the backbone besides pictures and padding."""
    passages: PromptKV
    """The modules through which keys and values of the prompt pass, in families that have `prompt_kv`."""
    prompt_tokens: ClassVar[slice] = ALL_TOKENS
    """The backbone's tokens among those of the prompt's keys and values."""
    acting_stream: ClassVar[str]
    suffix_roles: ClassVar[tuple[str, ...]] = ("action",)
    """The roles of positions of the acting stream."""

    def __init__(self, network: Any, folder: Path, checkpoint: str) -> None:
        """Make the adapter.

        Args:
            network: The policy of lerobot, with its configuration.
            folder: The folder of the checkpoint.
            checkpoint: The name by which `folder` was requested.
        """
        self.network, self.folder, self.checkpoint = network, folder, checkpoint
        self.config, self.evaluation = network.config, network.config.evaluation
        self.stacks = self._stacks()
        self._read_streams()
        self.renames = rename_map(folder)
        self.cameras = cameras_of(self.config.image_features, self.renames)
        self._show(self.cameras[:1])

    def with_cameras(self, cameras: Sequence[str]) -> Self:
        """Return the same policy, given pictures of several cameras; all but the first from `Observation.cameras`.

        Raises:
            ObservationError: Unless they are the first ones of the configuration, in its order: lerobot moves
                present cameras to the front.
        """
        if tuple(cameras) != self.cameras[: len(cameras)] or not cameras:
            raise ObservationError(
                f"cameras {list(cameras)} given; this checkpoint expects {list(self.cameras)}, in order"
            )
        other = copy(self)  # shares the network; what `_show` changes is its own
        other.stacks = dict(self.stacks)
        other._show(tuple(cameras))
        needs = frozenset(f"camera.{name}" for name in cameras[1:])
        other.card = replace(self.card, needs=needs, notes=other._notes())
        return other

    def _read_streams(self) -> None:
        self.streams = {name: stack.stream(name) for name, stack in self.stacks.items() if name != _VISION}

    def _show(self, cameras: tuple[str, ...]) -> None:
        self.shown_cameras, self.further_streams = cameras, {}
        if (vision := self.stacks.get(_VISION)) is not None:
            if vision.iterations is not None:  # a tower without iterations reads all pictures at once
                vision = self.stacks[_VISION] = replace(vision, iterations=len(cameras) + self.masked_cameras)
            self.further_streams = {_VISION: vision.stream(_VISION)}
        prompt = (*(f"image.{camera}" for camera in cameras), *self.other_roles, PADDING)
        self.role_names = {
            name: self.suffix_roles if name == self.acting_stream else prompt for name in self.streams
        }

    # -- what a family decides -------------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def build(cls, config: Any, folder: Path) -> Any:
        """Build the network with uninitialised weights."""

    @classmethod
    def current_keys(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The tensors by their current names, and those that a file may lack; see `tied`."""
        stored = cls.current_names(tensors)
        for name, other in cls.tied.items():
            if other in stored:
                stored.setdefault(name, stored[other])
        return stored

    @classmethod
    def _current_key(cls, name: str) -> str:
        """The network's name of one tensor of a file."""
        return next(iter(cls.current_names({name: torch.empty(0)})), name)

    @abstractmethod
    def _stacks(self) -> dict[str, Stack]:
        """The stacks in the order of the streams: `backbone`, others, the acting one, and `vision` if captured."""

    @property
    @abstractmethod
    def masked_cameras(self) -> int:
        """The number of cameras without a picture that still occupy positions, masked, after the shown ones."""

    def prefix_labels(self, language: Sequence[str]) -> list[str]:
        """The role of every backbone position of one row, from those of its language positions."""
        return list(language)

    def suffix_labels(self) -> list[str]:
        """The role of every suffix position."""
        return ["action"] * int(self.config.chunk_size)

    @cached_property
    @abstractmethod
    def tokenizer(self) -> Any:
        """The checkpoint's tokenizer."""

    @abstractmethod
    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return (B, chunk, action numbers) as the network puts them out for a batch in lerobot's keys.

        It is one inference.
        """

    # -- loading -----------------------------------------------------------------------------------------

    @classmethod
    def load(
        cls,
        checkpoint: str,
        device: str = "cpu",
        dtype: str | None = None,
        random_weights: bool = False,
        weights_seed: int = 0,
        **options: Any,
    ) -> Self:
        """Load a lerobot checkpoint from a folder or hub id.

        Args:
            checkpoint: Folder or hub id.
            device: Device in torch's spelling, such as `cuda:0`.
            dtype: float32 or bfloat16; None takes what the checkpoint's config says.
            random_weights: Same architecture, tokenizer and statistics, but random weights of `weights_seed`.
            weights_seed: Seed of random weights.
            **options: Choices that its files do not make, the fields of `choice`.

        Raises:
            CheckpointError: For missing files.
            WeightsError: For weights that are not exactly the model's.
        """
        folder, evaluation = checkpoint_folder(checkpoint), cls.choice(**options)
        config = cls._read_config(folder, evaluation)
        if dtype is not None:
            config.dtype = dtype
        with WithoutFilling(), while_reading(folder / CONFIG_FILE):
            network = cls.build(config, folder)
        if random_weights:
            initialise(network, weights_seed)
            weights = Weights(network.state_dict(), f"random twin of {checkpoint}", random=True)
        else:
            weights = read_weights(folder)
        tensors = cls.current_keys(weights.tensors)
        audit = load_weights(network, weights, tensors, cls.unread, name_in_module=cls._current_key)
        config.device = device
        policy = cls(network.to(device), folder, checkpoint)
        seed = weights_seed if random_weights else None
        loaded = Loaded(network, audit, str(getattr(config, "dtype", "float32")), device, checkpoint, folder, seed)
        policy.card = loaded.card(
            cls.family,
            policy.further_settings(),
            files=policy.side_files(),
            notes=policy._notes(),
            embodiment=ARM,
            cameras=policy.cameras,
            renames=policy.renames,
            chunk=config.chunk_size,
            execute=min(config.n_action_steps, config.chunk_size),
        )
        return policy

    @classmethod
    def _read_config(cls, folder: Path, evaluation: Any) -> Any:
        if not (folder / "config.json").is_file():
            raise CheckpointError(f"{folder / 'config.json'} is missing; {folder} is not a lerobot checkpoint")
        config: Any = cls.parse_config(folder, evaluation)
        check_one_frame(config, folder)
        if strange := [name for name in config.image_features if not name.startswith(IMAGES)]:
            raise CheckpointError(
                f"{folder} reads a picture as {strange[0]!r}; expected names such as {IMAGES}top. Give it one in "
                "config.json and in the processor files"
            )
        cls._check_steps(folder, PREPROCESSOR)
        if hasattr(config, "tokenizer_max_length"):
            # lerobot tokenises as the saved step says, whatever the configuration has.
            length = config.tokenizer_max_length = text_length(folder) or config.tokenizer_max_length
            if type(length) is not int or not 1 <= length <= MOST_TOKENS:
                raise CheckpointError(
                    f"{folder} reads {length} tokens of text (tokenizer_max_length); expected 1 to {MOST_TOKENS}. "
                    "Take the original configuration"
                )
        config.compile_model = False  # compiled graphs drop hooks
        config.evaluation = evaluation
        return config

    @classmethod
    def _check_steps(cls, folder: Path, pipeline: str) -> None:
        if cls.known_steps is not None:
            check_steps(folder, pipeline, (*NORMALISERS, *RELATIVE, TOKENIZER, *cls.known_steps))

    @classmethod
    def parse_config(cls, folder: Path, evaluation: Any) -> Any:
        """Return lerobot's configuration object of the folder's `config.json`, also of a newer lerobot's.

        Args:
            folder: The folder of the checkpoint.
            evaluation: The options of the loader, an instance of `choice`.

        Raises:
            CheckpointError: For a policy of another kind, and for a field that may change inference.
        """
        path = folder / CONFIG_FILE
        values = cls.current_values(read_json_object(path, CheckpointError, "Take the original file"), path)
        if (kind := values.get("type")) != cls.config_type:
            raise CheckpointError(
                f"{folder} holds a {kind!r} policy; expected {cls.config_type}. Pass the right --model"
            )
        config_class = PreTrainedConfig.get_choice_class(cls.config_type)
        field_names = {field.name for field in fields(config_class)}
        unread = tuple(filter(None, evaluation.unread.split(",")))
        values = known_values(values, {*field_names, "type"}, cls.newer_fields, unread, path, cls.takes_unread)
        if "rtc_config" in values:
            values["rtc_config"] = None  # real-time chunking mixes in actions of the chunk before
        # `from_pretrained` decodes in the same way, behind a command line with a help text for every field: 80 ms.
        if values.get(_ACTION_NAMES) is not None:  # draccus would make one text of a list in a list
            values[_ACTION_NAMES] = list(read_names(values[_ACTION_NAMES]) or ())
        with while_reading(path):
            return draccus.decode(config_class, {name: value for name, value in values.items() if name != "type"})

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields of `config.json` under the names that the installed lerobot has.

        A family that renames some raises CheckpointError for values that it cannot translate.
        """
        del path
        return values

    def further_settings(self) -> dict[str, str]:
        """Return settings that numbers depend on besides weights and side files; empty where files hold all."""
        return {}

    def side_files(self) -> dict[str, Path]:
        """Return every file besides the weights that loading and acting read: config, units, window, text."""
        files = side_files(self.folder)
        for prefix, folder in self.parts().items():
            files |= side_files(folder, f"{prefix}/")
        return files

    def parts(self) -> dict[str, Path]:
        """Return further folders that it reads, such as that of a vision-language model's tokenizer, by a name."""
        return {}

    def _notes(self) -> tuple[str, ...]:
        masked = self.cameras[len(self.shown_cameras) :]
        cameras = (f"cameras without a picture: {', '.join(masked)}",) if masked else ()
        misfit = names_misfit(getattr(self.config, _ACTION_NAMES, None), self._action_numbers)
        names = (f"names of actions ({_ACTION_NAMES}) are not used: {misfit}",) if misfit else ()
        return (*cameras, *names, f"units: {self._units()}")

    def _units(self) -> str:
        """The source of the statistics that turn actions into metres, or the reason why there are none."""
        if self.predicts_relative:
            return "actions are changes relative to the state, which nothing here adds"
        try:
            action, state = self.action_units, self.state_units
        except CheckpointError as error:
            return f"cannot act in metres: {error}"
        return f"action {action.mode} from {action.source}, state {state.mode} from {state.source}"

    # -- acting ------------------------------------------------------------------------------------------

    def act(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk of actions per observation; see the contract."""
        self.check_acting(observations, seeds)
        return self.action_units.restore(self.put_out(self.batch(observations), seeds))

    def check_acting(self, observations: Sequence[Observation], seeds: Sequence[int]) -> None:
        """Check observations, and raise CheckpointError for a checkpoint whose actions the arm cannot execute."""
        self.check(observations, seeds)
        if (reason := self._action_misfit()) is not None:
            raise CheckpointError(reason)

    def restored(self, output: Tensor) -> Tensor:
        """Return float32 actions (..., D), bit for bit those of `act`, with the graph of the network's output."""
        # The numbers of numpy's `restore`, on which a term of value zero hangs that carries the gradient.
        values = output.float()
        plain = values.detach().cpu().numpy()
        actions, slopes = (
            torch.from_numpy(of(plain)).to(values.device)
            for of in (self.action_units.restore, self.action_units.slopes)
        )
        return actions + slopes * (values - values.detach())

    def infer_without_acting(
        self, observations: Sequence[Observation], seeds: Sequence[int]
    ) -> NDArray[np.float32]:
        """Return (B, chunk, action numbers) as the network puts them out, without units."""
        self.check(observations, seeds)
        zeros = (
            np.zeros((len(observations), self.state_numbers), np.float32) if self.zero_filled_inputs() else None
        )
        return self.put_out(self.batch(observations, zeros), seeds)

    def predict(self, observations: Sequence[Observation], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return one chunk per recorded observation, by the checkpoint's own statistics; see the contract."""
        self.check(observations, seeds)
        states = np.stack([np.asarray(observation.state, np.float32) for observation in observations])
        if states.shape[1] != self.state_numbers:
            raise ObservationError(
                f"the recorded state has {states.shape[1]} numbers; this checkpoint reads {self.state_numbers}"
            )
        restore, normalised = self.action_units.restore, self.state_units.normalise(states)
        return restore(self.put_out(self.batch(observations, normalised), seeds))

    @property
    def state_numbers(self) -> int:
        """The count of numbers in the checkpoint's configuration."""
        return int(self.config.input_features[STATE].shape[0])

    @property
    def action_names(self) -> tuple[str, ...] | None:
        """The names in the configuration (`action_feature_names`), if there is one for each number."""
        return names_of(getattr(self.config, _ACTION_NAMES, None), self._action_numbers)

    @property
    def _action_numbers(self) -> int:
        """The count of numbers of an action in the checkpoint's configuration."""
        return int(self.config.output_features["action"].shape[0])

    @property
    def state_statistics(self) -> FeatureStatistics | None:
        """The statistics of states in the file that normalises them, also those that the mode does not need."""
        return self.state_units.statistics

    @property
    def unguarded_state(self) -> str | None:
        """The reason also for a checkpoint that reads the state as it is, or without its units."""
        try:
            units = self.state_units
        except CheckpointError as error:
            return str(error)
        if units.mode.startswith(UNCOMPARED):
            return f"the state is {units.mode} by {units.source}"
        return None

    @property
    def action_statistics(self) -> FeatureStatistics | None:
        """The statistics of actions in the file that normalises them, also those that the mode does not need."""
        return self.action_units.statistics

    @cached_property
    def predicts_relative(self) -> bool:
        """Whether the configuration or a step says so: lerobot then adds the state, which is not done here."""
        return bool(getattr(self.config, "use_relative_actions", False)) or adds_state(self.folder)

    def embodiment_mismatch(self) -> str | None:
        """Return a reason for other actions than an end-effector delta, another state, or no units for either."""
        return self._action_misfit() or self._state_misfit()

    def zero_filled_inputs(self) -> tuple[str, ...]:
        """Return the state, where it has other numbers than the arm's, or no units."""
        return ("state",) if self._state_misfit() else ()

    def configured_mismatch(self) -> str | None:
        """Return a reason for other actions than an end-effector delta."""
        dimensions = self._action_numbers
        if dimensions != _DIMENSIONS:
            return f"{self.checkpoint} acts in {dimensions} dimensions; the arm needs a 7-DoF end-effector delta"
        if self.predicts_relative:
            return f"{self.checkpoint} predicts changes relative to the state, and nothing here adds the state"
        return None

    def _action_misfit(self) -> str | None:
        return self.configured_mismatch() or _problem(lambda: self.action_units)

    def _state_misfit(self) -> str | None:
        example = self.laid_out(np.zeros((1, ARM_NUMBERS), np.float32)).shape[1]
        if example != self.state_numbers:
            return f"{self.checkpoint} reads {self.state_numbers} numbers as its state; the arm's are {example}"
        return _problem(lambda: self.state_units)

    def check_pictures(self, batch: Mapping[str, Tensor]) -> None:
        """Raise ObservationError unless a batch in lerobot's keys has pictures in [0, 1]: lerobot never rescales.

        Its cameras must be those that are shown, in the configuration's order.
        """
        batch_cameras = [key.removeprefix(IMAGES) for key in batch if key.startswith(IMAGES)]
        if batch_cameras != list(self.shown_cameras):
            raise ObservationError(
                f"cameras {batch_cameras} given; this policy is shown "
                f"{list(self.shown_cameras)} of {list(self.cameras)}, in order"
            )
        for camera in batch_cameras:
            picture = batch[f"{IMAGES}{camera}"]
            if not picture.is_floating_point() or picture.min() < 0 or picture.max() > 1:
                raise ObservationError(
                    f"pictures of {camera} are {picture.dtype} outside [0, 1]; divide bytes by 255"
                )

    def batch(
        self, observations: Sequence[Observation], state: NDArray[np.float32] | None = None
    ) -> dict[str, Tensor]:
        """Return the observations in lerobot's keys; the environment's picture goes to the first camera.

        Args:
            observations: The B rows of the batch.
            state: (B, numbers) as the network reads them; None for that of the observations.
        """
        device = self.config.device
        numbers = self.state(observations) if state is None else state
        tokens, mask = self.tokenise([o.instruction for o in observations], numbers)
        return {
            **{f"{IMAGES}{camera}": self._pictures(camera, observations) for camera in self.shown_cameras},
            STATE: torch.from_numpy(numbers).to(device),
            TOKENS: tokens.to(device),
            MASK: mask.to(device),
        }

    def state(self, observations: Sequence[Observation]) -> NDArray[np.float32]:
        """Return the states (B, numbers) as the network reads them.

        Raises:
            ObservationError: For another count of numbers.
        """
        rows = self.laid_out(np.stack([np.asarray(o.state, np.float32) for o in observations]))
        if rows.shape[1] != self.state_numbers:
            raise ObservationError(
                f"the state has {rows.shape[1]} numbers; this checkpoint reads {self.state_numbers}"
            )
        return self.state_units.normalise(rows)

    def _pictures(self, camera: str, observations: Sequence[Observation]) -> Tensor:
        """Return the pictures of a camera (B, 3, H, W) in [0, 1], each as this checkpoint looks at it."""
        return self.look(camera, [self.picture_of(camera, observation) for observation in observations])

    def picture_of(self, camera: str, observation: Observation) -> NDArray[np.uint8]:
        """The picture (H, W, 3) of a camera; the first camera is shown the environment's picture.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        return checked_picture(observation.image if camera == self.cameras[0] else observation.cameras[camera])

    def look(self, camera: str, images: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Return the part of each picture (H, W, 3) that this checkpoint looks at, (B, 3, H, W) in [0, 1]."""
        rows = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        return self.window(camera)(rows.to(self.config.device).float() / 255)

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """The text that is read, per instruction; `state` is (B, numbers) as the network reads them."""
        del state
        return [text if text.endswith("\n") else f"{text}\n" for text in instructions]

    def tokenise(
        self, instructions: Sequence[str], state: NDArray[np.float32] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return ids and mask (B, tokenizer_max_length); never truncates and never drops a word.

        Args:
            instructions: One per row.
            state: (B, numbers) as the network reads them, for prompts that hold it; None for zeros.

        Raises:
            InstructionError: For a prompt that is too long, and for a word that the tokenizer does not know.
        """
        if state is None:
            state = np.zeros((len(instructions), self.state_numbers), np.float32)
        prompts, length = self.prompts(instructions, state), self.config.tokenizer_max_length
        rows = [self.tokenizer(text)["input_ids"] for text in prompts]
        for text, row in zip(prompts, rows, strict=True):
            if len(row) > length:
                raise InstructionError(
                    f"{text!r} is {len(row)} tokens; this checkpoint reads {length}. Shorten it"
                )
            if self.tokenizer.unk_token_id in row:
                raise InstructionError(
                    f"{text!r} has a word this checkpoint's tokenizer does not know; it would act without "
                    f"reading it. Tokens: {self.tokenizer.convert_ids_to_tokens(row)}"
                )
        tokens = torch.full((len(rows), length), self.tokenizer.pad_token_id or 0)  # masked: any id would do
        mask = torch.zeros((len(rows), length), dtype=torch.bool)
        for index, row in enumerate(rows):
            tokens[index, : len(row)] = torch.tensor(row)
            mask[index, : len(row)] = True
        return tokens, mask

    @classmethod
    def check_words(cls, checkpoint: str, instructions: Sequence[str], **options: Any) -> None:
        """Raise InstructionError as `tokenise` would, from configuration and tokenizer alone."""
        cls._text_reader(checkpoint, options).tokenise(instructions)

    @classmethod
    def _text_reader(cls, checkpoint: str, options: Mapping[str, Any]) -> Self:
        """Return a policy without a network, which packs and tokenises; `options` are those of its loader."""
        text = cls.__new__(cls)
        text.folder, text.evaluation = checkpoint_folder(checkpoint, TEXT_FILES), cls.choice(**options)
        text.config = cls._read_config(text.folder, text.evaluation)
        text.cameras = text.shown_cameras = cameras_of(text.config.image_features, rename_map(text.folder))[:1]
        return text

    def window(self, camera: str) -> PictureWindow:
        """The part of one camera's picture that this checkpoint looks at."""
        if camera not in self._windows:
            size = tuple(self.config.image_features[f"{IMAGES}{camera}"].shape[-2:])
            self._windows[camera] = read_window(self.folder, f"{IMAGES}{camera}", size)
        return self._windows[camera]

    @cached_property
    def _windows(self) -> dict[str, PictureWindow]:
        return {}

    @cached_property
    def state_units(self) -> Normaliser:
        """The map from metres and radians to what the network reads.

        Raises:
            CheckpointError: If nothing says it.
        """
        return self.units_of(STATE, "STATE")

    @cached_property
    def action_units(self) -> Normaliser:
        """The units that turn the network's output into metres and radians.

        Raises:
            CheckpointError: If nothing says them.
        """
        return self.units_of("action", "ACTION")

    def units_of(self, feature: str, kind: str) -> Normaliser:
        """Return the units of one feature, STATE or ACTION.

        Raises:
            CheckpointError: If nothing says them.
        """
        if (units := self.own_units(feature, kind)) is not None:
            return units
        raise CheckpointError(
            f"{self.checkpoint} does not normalise its {feature} and no policy_preprocessor.json says so: "
            "its units are unknown"
        )

    def own_units(self, feature: str, kind: str) -> Normaliser | None:
        """Return the units in the checkpoint's processor files or old buffers; None if it normalises nothing.

        Raises:
            CheckpointError: For statistics that are missing, or of another count of numbers.
        """
        pipeline = PREPROCESSOR if kind == "STATE" else POSTPROCESSOR
        self._check_steps(self.folder, pipeline)  # behind the policy only actions depend on them
        if (self.folder / f"{pipeline}.json").is_file():
            units: Normaliser | None = read_normaliser(self.folder, pipeline, feature, kind)
        else:
            units = from_buffers(self._buffers, self.config.normalization_mapping, feature, kind, self.checkpoint)
        numbers = self.state_numbers if kind == "STATE" else self._action_numbers
        if units is not None and units.mode != "IDENTITY" and units.low.shape != (numbers,):
            raise CheckpointError(
                f"{self.checkpoint} has statistics of shape {units.low.shape} for its {feature}, which has "
                f"{numbers} numbers ({units.source}). Take the statistics of the data set it was trained on"
            )
        return units

    @cached_property
    def _buffers(self) -> dict[str, NDArray[np.float32]]:
        return read_buffers(self.folder)

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of prefix and suffix as the family packs them."""
        return self.packed_roles(
            *self.tokenise([o.instruction for o in observations], self.read_state(observations))
        )

    def read_state(self, observations: Sequence[Observation]) -> NDArray[np.float32] | None:
        """Return (B, numbers) as the network reads them; None where it is given zeros in place of the arm's state.

        A recorded state of the checkpoint's own width is read, whatever the arm has.
        """
        recorded = {np.shape(observation.state) for observation in observations} == {(self.state_numbers,)}
        if self.zero_filled_inputs() and not (recorded and _problem(lambda: self.state_units) is None):
            return None
        return self.state(observations)

    def packed_roles(self, tokens: Tensor, mask: Tensor) -> dict[str, list[Roles]]:
        """The roles for instructions as (B, tokenizer_max_length) ids and mask."""
        suffix = Roles.from_labels(self.suffix_labels())
        language = [
            self.text_labels(row, valid) for row, valid in zip(tokens.tolist(), mask.tolist(), strict=True)
        ]
        return {
            "backbone": [Roles.from_labels(self.prefix_labels(row)) for row in language],
            self.acting_stream: [suffix] * len(language),
        }

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """The role of every position of a prompt."""
        special = frozenset(self.tokenizer.all_special_ids)
        labels = ["special" if number in special else "language" for number in ids]
        return [label if is_text else PADDING for label, is_text in zip(labels, valid, strict=True)]

    def read_late_files(self) -> None:
        """Read the tokenizer."""
        self.tokenizer  # noqa: B018 - read once, and kept

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each instruction, without padding."""
        tokens, mask = self.tokenise(instructions)
        return [tuple(row[valid].tolist()) for row, valid in zip(tokens, mask, strict=True)]

    def tap(self, site: Site) -> Tap:
        """Return the tap of the site's stack; the prompt's keys and values pass once it is read."""
        if self.stream_of(site) is self.prompt_kv:
            return kv_tap(self.passages, site, self.prompt_tokens)
        return self.stacks[site.stream].tap(site)

    # -- verification ------------------------------------------------------------------------------------

    @abstractmethod
    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """Return what the network puts out with the randomness of a golden reference.

        These are `actions` (B, chunk, action numbers), and quantities that only this inference has.
        """

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return modules whose outputs a golden reference holds, by the name of the quantity."""
        return {}

    def watched_inputs(self) -> dict[str, nn.Module]:
        """Return modules whose inputs `further_outputs` reads, by any name."""
        return {}

    def recorded_padding(self, recorded: Arrays) -> NDArray[np.bool_]:
        """Return (B, T): the validity of every backbone position for recorded ids, by the adapter's own roles."""
        tokens, mask = (torch.from_numpy(recorded[name]) for name in ("in_lang_tokens", "in_lang_mask"))
        return np.stack([row.valid for row in self.packed_roles(tokens, mask.bool())["backbone"]])

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return quantities of a golden reference that only this family has, or has in another form."""
        del run
        return {}


def checked_steps(steps: int, folder: Path) -> int:
    """Return the number of flow steps.

    Raises:
        CheckpointError: If there are none: the action would then be the noise.
    """
    if steps < 1:
        raise CheckpointError(f"{folder} makes {steps} flow steps: its action would be noise. Expected 1 or more")
    return steps


def _problem(read: Callable[[], object]) -> str | None:
    """The message of the CheckpointError that `read` raises; None if it raises none."""
    try:
        read()
    except CheckpointError as error:
        return str(error)
    return None
