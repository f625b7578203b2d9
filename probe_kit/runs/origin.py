"""Files and choices that a run was made of, recorded so that later steps find them by themselves."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self

from probe_kit.hooks.contract.card import EMBEDDED

ORIGIN = "origin"
"""Entry of a certificate."""
SUITE = "suite"
OF_SCENE = "scene."
"""Beginning of the name of a file that a field of the scene gives."""


class LoadedModel(Protocol):
    """The model of a run's settings; see `ModelSettings`."""

    @property
    def family(self) -> str:
        """Its name."""

    @property
    def options(self) -> Mapping[str, Any]:
        """Options of the family."""

    @property
    def random_weights(self) -> bool:
        """Whether random weights were requested."""

    @property
    def weights_seed(self) -> int:
        """Seed of requested random weights."""


@dataclass(frozen=True)
class Origin:
    """Files and choices of one process that played episodes of a run; none is part of the run's identity.

    files: absolute, by field of the source's settings, such as `suite`, `folder` or `scene.background`.
    checkpoint: absolute folder, hub id, or a word of the family; empty if unknown. options: of the family, as they
    were passed, files and folders absolute. random_weights: whether random weights were requested, which a file
    that calls its weights random is not. weights_seed: of requested random weights. repositories: commits of
    further repositories of the hub, by name, which a repetition reads again.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    checkpoint: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    random_weights: bool = False
    weights_seed: int = 0
    repositories: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: LoadedModel,
        files: Mapping[str, Path],
        checkpoint: str,
        repositories: Mapping[str, str] = MappingProxyType({}),
    ) -> Self:
        """Return the origin of a process. files: of its source. checkpoint, repositories: of the model's card."""
        return cls(
            files={name: _absolute(path) for name, path in files.items()},
            checkpoint=_absolute(checkpoint) if is_here(checkpoint) else checkpoint,
            options={**model.options, **{name: _absolute(path) for name, path in option_files(model).items()}},
            random_weights=model.random_weights,
            weights_seed=model.weights_seed,
            repositories=dict(repositories),
        )

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the origin in the record of a process; an empty one where it has none."""
        return cls(**record.get(ORIGIN, {}))

    @property
    def suite(self) -> str | None:
        """The suite's folder; None for the embedded suite and for runs without one."""
        return self.files.get(SUITE)

    @property
    def scene_files(self) -> dict[str, Path]:
        """The files of the scene by its fields."""
        return {
            name.removeprefix(OF_SCENE): Path(path)
            for name, path in self.files.items()
            if name.startswith(OF_SCENE)
        }

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def option_files(model: LoadedModel) -> dict[str, Path]:
    """Files and folders of this machine that options of a model name."""
    from probe_kit.hooks.registry import get_family

    family = get_family(model.family)
    names = [option.name for option in (() if family is None else family.options) if option.is_path]
    # The same text may be a word of the family, such as a data set's name.
    return {name: Path(str(model.options[name])) for name in names if is_here(model.options.get(name))}


def is_here(text: str | None) -> bool:
    """Whether a setting, such as a checkpoint, is a folder or file of this machine."""
    if text in (None, "", EMBEDDED):
        return False
    try:
        return Path(str(text)).expanduser().exists()
    except (OSError, RuntimeError):  # no path at all, or ~name of an unknown user
        return False


def _absolute(path: Path | str) -> str:
    return str(Path(path).expanduser().absolute())
