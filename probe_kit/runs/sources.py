"""Files and choices that a run was made of, recorded so that later steps find them by themselves."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self

from probe_kit.hooks.contract.card import EMBEDDED

SOURCES = "sources"
"""Entry of a certificate."""


class ModelWithSources(Protocol):
    """The model of a run's settings; see `ModelSettings`."""

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
class RunSources:
    """Sources of one process that played episodes of a run; none of them is part of the run's identity.

    suite: absolute folder; None for the embedded suite and for runs without one. checkpoint: absolute folder, hub
    id, or a word of the family; empty if unknown. scene_files: absolute, by field of the scene. options: of the
    family, as they were passed. random_weights: whether random weights were requested, which a file that calls its
    weights random is not. weights_seed: of requested random weights. repositories: commits of further repositories
    of the hub, by name, which a repetition reads again.
    """

    suite: str | None = None
    checkpoint: str = ""
    scene_files: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    random_weights: bool = False
    weights_seed: int = 0
    repositories: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: ModelWithSources,
        suite: Path | None,
        scene_files: Mapping[str, Path],
        checkpoint: str,
        repositories: Mapping[str, str] = MappingProxyType({}),
    ) -> Self:
        """Sources of a process with this model, suite and scene. checkpoint, repositories: of the model's card."""
        return cls(
            suite=None if suite is None else _absolute(suite),
            checkpoint=_absolute(checkpoint) if _is_here(checkpoint) else checkpoint,
            scene_files={name: _absolute(path) for name, path in scene_files.items()},
            options=dict(model.options),
            random_weights=model.random_weights,
            weights_seed=model.weights_seed,
            repositories=dict(repositories),
        )

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """Sources in the record of a process; none where it has none."""
        return cls(**record.get(SOURCES, {}))

    def to_json(self) -> dict[str, Any]:
        """The sources as plain values."""
        return asdict(self)


def _absolute(path: Path | str) -> str:
    return str(Path(path).expanduser().absolute())


def _is_here(checkpoint: str) -> bool:
    if checkpoint in ("", EMBEDDED):
        return False
    try:
        return Path(checkpoint).expanduser().exists()
    except (OSError, RuntimeError):  # no path at all, or ~name of an unknown user
        return False
