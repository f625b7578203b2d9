"""The class `Source`, which gives the observations of a run. A source is one class and its settings.

A source knows neither what a model does with its observations nor how runs are stored.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._terminal.field_options import FieldOption, Part, options_of
from probe_kit.errors import InstructionError, PolicyFailedError, RecordingError, UnitsError, UsageError
from probe_kit.extract.sources.inputs import describe_spellings
from probe_kit.extract.sources.units import Units, UnitsNote, compare_units
from probe_kit.hooks.checkpoints.third_party import copy_observations, while_acting
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.contract.observation import Observation

if TYPE_CHECKING:
    from probe_kit.env import SceneSpec
    from probe_kit.extract.sources.player import Opens
    from probe_kit.hooks import Policy
    from probe_kit.hooks.capturing.edits import Edit, Vectors
    from probe_kit.hooks.contract.card import DeclaredInputs
    from probe_kit.runs.plan import Row
    from probe_kit.suite import Suite


STATE_UNITS, ACTION_UNITS = "state units", "action units"
"""The headings of what does not fit the statistics of a checkpoint."""
REFUSED_WITHOUT_ACTING = (
    "protocol", "rotation", "video", "batch=auto", "execute", "later_views", "edits",
)  # fmt: skip
"""The fields of other parts that do not apply to a source that shows what was recorded."""


class SourceSettings(Part):
    """Settings of a source, which open it.

    Attributes:
        kind: The name of the source in files.
        command: The option by which a command names it; empty for the scene.
        shows: The reason why options of other sources do not apply.
        opens: MODULE:CLASS of the `Source`, which is imported when it is opened.
        subject: The subject of its options, in words.
        loads: The things that are loaded of it, in words.
        decides: The fields of other parts that are the source's own.
        refuses: The fields of other parts that do not apply, some with the only value that does not.
        moves: The fields that a later command may give anew, because a file or module lies elsewhere, with their
            help.
        played: The word before the name in a run's label; empty for a label without it.
        of_run: Whether a later command reads the observations from the run itself.
    """

    kind: str

    command: ClassVar[str] = ""
    shows: ClassVar[str] = ""
    opens: ClassVar[str] = ""
    subject: ClassVar[str] = ""
    loads: ClassVar[str] = ""
    decides: ClassVar[tuple[str, ...]] = ()
    refuses: ClassVar[tuple[str, ...]] = ()
    moves: ClassVar[Mapping[str, str]] = MappingProxyType({})
    played: ClassVar[str] = ""
    of_run: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """The name in tables."""
        return self.kind

    def open(self, selects_only: bool = False) -> "Source[Any]":
        """Open the source; with `selects_only` only the chosen rows are needed. Raises what is wrong with it."""
        module, _, name = self.opens.partition(":")
        source: type[Source[Any]] = getattr(import_module(module), name)
        return source.open(self, selects_only)

    @property
    def scene_spec(self) -> "SceneSpec":
        """The scene that is played. Raises UsageError for a source without one."""
        raise UsageError(f"a run with {self.command} has no scene")

    @property
    def picture_words(self) -> str:
        """The size of pictures in a run's label, WIDTHxHEIGHT; empty where the source decides it."""
        return ""

    def steps(self) -> int:
        """Count the actions that an episode can have; 0 where nothing acts."""
        return 0

    @property
    def is_scene(self) -> bool:
        """Whether the scene of Act2Answer is played, which no option of a command has to name."""
        return not self.command

    @classmethod
    def command_options(cls) -> dict[str, FieldOption]:
        """Return the options of a command by the field that they give; a field of a scene is `scene.NAME`."""
        return {option.field: option for option in options_of(cls)}

    @classmethod
    def replaced_by(cls, typed: Collection[str]) -> set[str]:
        """Return the fields whose values typed parameters replace."""
        return {field for field, option in cls.command_options().items() if option.parameter in typed}

    def files(self) -> dict[str, Path]:
        """Return files and folders of this machine from which the source is made, by the field that gives them.

        A field of a scene is `scene.NAME`. A run records them, so that `--config RUN` finds them again.
        """
        return {}

    @classmethod
    def with_files(cls, values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
        """Return settings as values, with other texts for `files`."""
        return {**values, **files}

    @classmethod
    def with_moved(cls, values: Mapping[str, Any], moved: Mapping[str, Any]) -> dict[str, Any]:
        """Return settings as values, with the parts that are given anew."""
        return {**values, **moved}

    @classmethod
    def find_again(cls, files: Mapping[str, str]) -> None:
        """Prepare this process for the source of a run that recorded these `files`."""
        del files

    def marks(self) -> list[str]:
        """Return the parts of a run's label that name the source."""
        return [f"{self.played} {self.name}"] if self.played else []


@dataclass(frozen=True)
class Played:
    """The settings of a player beside its source.

    Attributes:
        frames: The frames to keep: `ends`, `all` or `none`.
        calls: The number of inferences whose inputs are kept.
        script: The name of a script that plays by itself, None without one.
    """

    frames: str = "none"
    calls: int = 1
    script: str | None = None


class Source[Chosen: SourceSettings](ABC):
    """An opened source; `check` returns the same source as it is shown to a model.

    Attributes:
        own_units: Whether actions are predictions in the checkpoint's own units; those of an arm otherwise.
        executes: Whether actions move anything.
        groups: The groups of rows, in words.
        columns: The names of numbers that become labels, such as facts.
        chunk: The number of actions that a policy predicts at a time; 0 where its card says it.
        suite: The suite of questions with two pictures; None for other sources.
        units: The comparison of states with the statistics of the policy that was checked.
    """

    own_units: ClassVar[bool] = True
    executes: ClassVar[bool] = True
    groups: ClassVar[str] = "groups of episodes"
    columns: tuple[str, ...] = ()
    chunk: int = 0
    settings: Chosen
    suite: "Suite | None" = None
    units: Units = Units()

    @classmethod
    @abstractmethod
    def open(cls, settings: Chosen, selects_only: bool) -> Self:
        """Open the source that settings choose; see `SourceSettings.open`."""

    def for_questions(self) -> Self:
        """Return the source with a row per question, which is about the row's first observation."""
        return self

    def for_cameras(self, cameras: Sequence[str]) -> Self:
        """Return the source as it is shown to a model with these cameras that answers and does not act.

        Raises an error for cameras that get no picture.
        """
        del cameras
        return self

    def decided(self) -> Mapping[str, Any]:
        """Return fields of a run's settings that the source itself decides, by name."""
        return {}

    @property
    def name(self) -> str:
        """The name in tables."""
        return self.settings.name

    @abstractmethod
    def rows(self, seed: int) -> "tuple[Row, ...]":
        """Return the rows in order; nothing about a row depends on which others were selected."""

    @abstractmethod
    def identity(self, execute: int) -> dict[str, Any]:
        """Return the part of a run's identity that says where observations come from.

        The number of actions per inference, `execute`, is 0 for a model that predicts none.
        """

    @abstractmethod
    def selection(self, rows: "Sequence[Row]") -> dict[str, Any]:
        """Return the settings that say what was selected; no part of a run's identity."""

    @abstractmethod
    def describe(self, rows: "Sequence[Row]") -> dict[str, str]:
        """Return the lines of a plan that say what is shown, by heading."""

    @abstractmethod
    def check(self, policy: "Policy", accept_units: bool) -> "tuple[Self, Policy]":
        """Return the source as a policy is shown it, and the policy for its cameras.

        Raises an error for cameras, states, units or actions that do not fit.
        """

    @abstractmethod
    def play(self, played: Played) -> "Opens":
        """Return a function that opens a player of this source, here or in a process of its own."""

    @abstractmethod
    def example(self, instruction: str) -> "Observation":
        """Return a blank observation of the source's shapes, whose tokens are counted."""

    @cached_property
    def instructions(self) -> tuple[str, ...]:
        """The instructions, each once, in alphabetical order."""
        return tuple(sorted({row.instruction for row in self.rows(0)}))

    def same_instructions(self) -> list[str]:
        """Return a sentence, without its stop, for all tasks that are one instruction, by spelling or by text."""
        return describe_spellings(self.instructions)

    def early_checks(self, inputs: "DeclaredInputs", checkpoint: str) -> list[Callable[[], object]]:
        """Return checks against the inputs that a checkpoint declares, before it is loaded."""
        del inputs, checkpoint
        return []

    def shown_cameras(self, declared: "DeclaredInputs | None" = None) -> tuple[str, ...] | None:
        """Return the model's cameras that get a picture, the first one in front; None if only a model can say.

        They are those of the model once the source was checked against it. Before, `declared` has the inputs of a
        checkpoint that is not loaded yet, None where its files do not say.
        """
        del declared
        return None

    def known_early(self) -> dict[str, Any] | None:
        """Return the settings of a run that are known before a model is loaded; None where there are none."""
        return None

    def check_same(self, settings: Mapping[str, Any]) -> None:
        """Raise OtherFramesError for another version of the source than that of a run with these `settings`."""
        del settings

    def name_parts(self) -> list[Any]:
        """Return the parts of a run's default name beside its identity."""
        return []

    def smaller_groups(self, rows: "Sequence[Row]") -> str:
        """Return how probes get more groups of these rows than their own, in words; empty where they cannot."""
        del rows
        return ""

    def rehearse(self, rows: "Iterable[Row]") -> None:
        """Set the first rows up. Raises an error if none can be."""
        del rows

    @property
    def suite_parent(self) -> Any:
        """The hash of the suite that a suite was selected from; None for any other."""
        return None

    @property
    def decoder(self) -> str | None:
        """The name and version of the decoder of stored videos on this machine; None where nothing is decoded."""
        return None

    def content_notes(self) -> tuple[str, ...]:
        """Return a sentence for every input without content, such as a black camera, in a few frames.

        They are empty where the source has not shown anything yet.
        """
        return ()

    def edits_by_condition(self) -> "Mapping[str, tuple[Sequence[Edit], Vectors]]":
        """Return the edits of the conditions of rows, with their vectors; empty where no row has a condition."""
        return {}

    def unit_notes(self, accepted: bool) -> dict[str, UnitsNote]:
        """Return what does not fit the statistics of the policy that was checked, by heading.

        Args:
            accepted: Whether other units were accepted.
        """
        note = self.units.note(accepted)
        return {} if note is None else {STATE_UNITS: note}

    def targets(self) -> tuple[str, ...]:
        """Return the built-in targets of probes that the rows have, such as `side.correct` or `env.left`."""
        return ()


def raise_together(checks: Iterable[Callable[[], object]]) -> None:
    """Make all checks, and raise the error of one that fails, or one error that names those of all that fail."""
    errors: list[RecordingError | InstructionError] = []
    for check in checks:
        try:
            check()
        except (RecordingError, InstructionError) as error:
            errors.append(error)
    if len(errors) == 1:
        raise errors[0]
    if errors:
        listed = "\n".join(f"  {number}. {error}" for number, error in enumerate(errors, start=1))
        raise RecordingError(f"{len(errors)} things about the recordings do not fit the model:\n{listed}")


FIRST_EPISODES = 4
"""The episodes of a scene or environment whose first states are compared, before any is played."""


def compare_states(
    policy: "Policy",
    episodes: Sequence[NDArray[np.float32]],
    names: Sequence[str],
    recorded: FeatureStatistics | None = None,
    begins: bool = False,
) -> Units:
    """Compare states (T, D) of every episode with the checkpoint's statistics; see `compare_units`.

    Nothing is compared for a policy that reads or normalizes no state.
    """
    expected = None if policy.state_numbers is None else policy.state_statistics
    return Units() if expected is None else compare_units(expected, episodes, names, recorded, begins)


def check_units(units: Units, where: str, policy: "Policy", accepted: bool) -> None:
    """Raise UnitsError for states in other units than the checkpoint's statistics, unless that is accepted.

    Args:
        units: The comparison of the states.
        where: The source, for the message.
        policy: The policy whose checkpoint the message names.
        accepted: Whether such states are accepted.
    """
    if units.are_other and not accepted:
        raise UnitsError(
            f"{where}: states do not fit the statistics of {policy.card.checkpoint}: {units.refused}. These are "
            "other units or another robot. Give the states as in training, take a checkpoint that was trained on "
            "such states, or accept it with --accept-units"
        )


def other_order(policy: "Policy", names: Sequence[str]) -> str | None:
    """Return why numbers of these names are not a policy's actions in their order; None where nothing says so.

    Names are compared where both sides have any; positions such as `0`, `1` are no names.
    """
    predicted = policy.action_names
    if predicted is None or tuple(names) == predicted or all(name.isdecimal() for name in names):
        return None
    kind = "in another order" if sorted(predicted) == sorted(names) else "otherwise"
    return (
        f"the checkpoint names its actions {', '.join(predicted)}, and they are named {kind}: {', '.join(names)}"
    )


def exchanged_names(policy: "Policy", names: Sequence[str]) -> str | None:
    """Return the reason of `other_order`, only where a name that both sides have is at another place."""
    predicted = policy.action_names or ()
    places = {name: position for position, name in enumerate(predicted)}
    moved = [name for position, name in enumerate(names) if places.get(name, position) != position]
    return other_order(policy, names) if moved else None


def predicted_once(policy: "Policy", observation: Observation) -> NDArray[np.float32]:
    """Return one prediction (chunk, D) of a policy, in its own units. Raises PolicyFailedError otherwise."""
    with while_acting(policy.card.family, policy.card.checkpoint):
        chunks = policy.predict(copy_observations([observation]), [0])
        check_predictions(chunks, 1)
    chunk: NDArray[np.float32] = chunks[0]
    return chunk


def check_predictions(chunks: Any, count: int, width: int | None = None) -> None:
    """Raise PolicyFailedError unless `chunks` are actions (count, chunk, D) float32, with D `width` if known.

    Actions that are NaN cost their own episode only; the environment raises the error for them.
    """
    array = chunks if isinstance(chunks, np.ndarray) else None
    shape: tuple[int, ...] = () if array is None else array.shape
    fits = len(shape) == 3 and shape[0] == count and shape[1] >= 1 and width in (None, shape[2])
    if array is None or not fits or array.dtype != np.float32:
        described = type(chunks).__name__ if array is None else f"ndarray of shape {shape} and {array.dtype}"
        raise PolicyFailedError(
            f"the policy gave a {described} for {count} observations; expected a numpy array "
            f"({count}, chunk, {width or 'D'}) of float32 actions"
        )
