"""The files of a lerobot checkpoint: its configuration, the processors that go with it, and names of tensors.

Nothing here needs the network, but `build` makes it.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import draccus  # the decoder of lerobot, which installs it
import torch
from lerobot.configs.policies import PreTrainedConfig
from torch import Tensor

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import CONFIG_FILE
from probe_kit.hooks.families.shared.feature_names import read_names
from probe_kit.hooks.families.shared.kinds import IMAGES, Evaluation
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    CROP,
    NORMALISERS,
    PREPROCESSOR,
    RELATIVE,
    TOKENIZER,
    Inert,
    check_one_frame,
    check_steps,
    known_values,
    text_length,
)

MOST_TOKENS = 1 << 16
"""The most tokens of a prompt: far beyond any policy, and no memory without end."""
ACTION_NAMES = "action_feature_names"


class LerobotFiles:
    """The reading of a checkpoint's files; a family declares which fields, steps and tensors it has.

    Attributes:
        evaluation: The options of the loader, an instance of `choice`.
    """

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
        if values.get(ACTION_NAMES) is not None:  # draccus would make one text of a list in a list
            values[ACTION_NAMES] = list(read_names(values[ACTION_NAMES]) or ())
        with while_reading(path):
            return draccus.decode(config_class, {name: value for name, value in values.items() if name != "type"})

    @classmethod
    def current_values(cls, values: dict[str, Any], path: Path) -> dict[str, Any]:
        """Return the fields of `config.json` under the names that the installed lerobot has.

        A family that renames some raises CheckpointError for values that it cannot translate.
        """
        del path
        return values
