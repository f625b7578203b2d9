"""Base adapter of lerobot's policies: `loading` reads its files, `packing` packs, `golden` compares.

The `from_pretrained` of lerobot is never used: it returns partly or fully random models without an error.
"""

from abc import abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, ObservationError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE, is_weights, side_files
from probe_kit.hooks.checkpoints.folders import adapter_in, checkpoint_folder
from probe_kit.hooks.checkpoints.weights import Weights, load_weights, read_weights
from probe_kit.hooks.contract.card import ARM
from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.contract.sites import PADDING, Site
from probe_kit.hooks.families.shared.feature_names import names_misfit
from probe_kit.hooks.families.shared.kinds import cameras_of
from probe_kit.hooks.families.shared.lerobot.golden import RecordedPolicy
from probe_kit.hooks.families.shared.lerobot.loading import ACTION_NAMES
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    rename_map,
)
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.taps import ALL_TOKENS, Stack, kv_tap
from probe_kit.models.building import LimitedSize, WithoutFilling, builds_sizes_only, initialise
from probe_kit.models.decoding import PromptKV

_VISION = "vision"
"""The stream of a vision tower."""


def _limit_size(folder: Path, random_weights: bool) -> AbstractContextManager[object]:
    """Return a context that builds no network which the weights in `folder` could not fill; see `LimitedSize`."""
    if random_weights or builds_sizes_only():
        return nullcontext()
    adapter = adapter_in(folder)
    weights_folder = folder if adapter is None else adapter.base_folder()
    total = sum(file.stat().st_size for file in weights_folder.iterdir() if is_weights(file) and file.is_file())
    return LimitedSize(folder, total) if total else nullcontext()


class LerobotPolicy(RecordedPolicy):
    """A lerobot policy behind the Policy contract; subclasses say how it puts out actions.

    `cameras` are those that a picture can be given for; `shown_cameras` get one, in the configuration's order.
    """

    family: ClassVar[str]
    passages: PromptKV
    """The modules through which keys and values of the prompt pass, in families that have `prompt_kv`."""
    prompt_tokens: ClassVar[slice] = ALL_TOKENS
    """The backbone's tokens among those of the prompt's keys and values."""

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

    # -- what a family decides --------------------------------------------------------------------------

    @abstractmethod
    def _stacks(self) -> dict[str, Stack]:
        """The stacks in the order of the streams: `backbone`, others, the acting one, and `vision` if captured."""

    @property
    @abstractmethod
    def masked_cameras(self) -> int:
        """The number of cameras without a picture that still occupy positions, masked, after the shown ones."""

    @abstractmethod
    def put_out(self, batch: dict[str, Tensor], seeds: Sequence[int]) -> NDArray[np.float32]:
        """Return (B, chunk, action numbers) as the network puts them out for a batch in lerobot's keys.

        It is one inference.
        """

    # -- loading ----------------------------------------------------------------------------------------

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
        with WithoutFilling(), _limit_size(folder, random_weights), while_reading(folder / CONFIG_FILE):
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
        misfit = names_misfit(getattr(self.config, ACTION_NAMES, None), self._action_numbers)
        names = (f"names of actions ({ACTION_NAMES}) are not used: {misfit}",) if misfit else ()
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

    # -- acting -----------------------------------------------------------------------------------------

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

    # -- capture ----------------------------------------------------------------------------------------

    def tap(self, site: Site) -> Tap:
        """Return the tap of the site's stack; the prompt's keys and values pass once it is read."""
        if self.stream_of(site) is self.prompt_kv:
            return kv_tap(self.passages, site, self.prompt_tokens)
        return self.stacks[site.stream].tap(site)


def checked_steps(steps: int, folder: Path) -> int:
    """Return the number of flow steps.

    Raises:
        CheckpointError: If there are none: the action would then be the noise.
    """
    if steps < 1:
        raise CheckpointError(f"{folder} makes {steps} flow steps: its action would be noise. Expected 1 or more")
    return steps
