"""`Task`: what a model does with the observations of a source. It acts, is captured, or answers questions.

A task knows no particular source, and keeps nothing: all that is chosen is in the settings.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

from probe_kit.errors import UsageError
from probe_kit.extract.needs import PlannedSizes
from probe_kit.extract.plan import Row
from probe_kit.extract.rollout.calibration import Calibration
from probe_kit.extract.rollout.controllers import Controller
from probe_kit.extract.settings import Settings
from probe_kit.extract.sources.source import Source

if TYPE_CHECKING:
    from probe_kit.hooks import Model
    from probe_kit.hooks.contract.card import ModelCard
    from probe_kit.hooks.family import Family

Fitted = tuple[Settings, Source[Any], Controller, Calibration | None]
"""Settings and source as the model is shown them, what plays, and what chose a batch that was left open."""


class Task[Chosen: Settings, Loaded: "Model"](ABC):
    """A task, whose settings are of one class and whose models are of one kind.

    names_all_items: whether it needs the whole suite besides the chosen items, for the names of other objects.
    """

    names_all_items: ClassVar[bool] = False

    # -- before a model is loaded ----------------------------------------------------------------------

    def check_meaningless(self, settings: Chosen) -> None:
        """Raise UsageError for settings that have no effect in this task, with this source or model."""
        del settings

    @abstractmethod
    def check_family(self, settings: Chosen, family: "Family | None") -> None:
        """Raise UsageError for a family that is not made for the task. family: None for a script."""

    def view_of(self, source: Source[Any]) -> Source[Any]:
        """Return the source as the task shows it."""
        return source

    def rows(self, settings: Chosen, source: Source[Any]) -> tuple[Row, ...]:
        """Return the rows of a plan, with what the task adds to them."""
        return source.rows(settings.seed)

    @abstractmethod
    def texts(self, settings: Chosen, source: Source[Any]) -> Iterable[str]:
        """Return the texts whose words a family must know, said before anything of its checkpoint is read."""

    def early_checks(self, settings: Chosen, source: Source[Any], fetch: bool) -> list[Callable[[], object]]:
        """Return checks against what the checkpoint's files declare. fetch: see `Family.check`."""
        del settings, source, fetch
        return []

    def declared_cameras(self, settings: Chosen) -> tuple[str, ...] | None:
        """Return the cameras that the files of the checkpoint declare; None where they do not say."""
        del settings
        return None

    def planned(self, settings: Chosen, sizes: PlannedSizes) -> Chosen:
        """Return the settings of a plan without a model. Raises CheckpointError for a model that cannot do it."""
        del sizes
        return settings

    # -- with it ---------------------------------------------------------------------------------------

    @abstractmethod
    def load(self, settings: Chosen) -> Loaded | None:
        """Load the model of some settings; None for a script."""

    def check_loaded(self, settings: Chosen, model: Loaded) -> None:
        """Raise UsageError for a model that was loaded already and is not that of the settings."""
        del settings, model

    @abstractmethod
    def fit(self, settings: Chosen, source: Source[Any], model: Loaded | None) -> Fitted:
        """Fit source, settings and model to each other. Raises what does not fit."""


def task_of(settings: Settings) -> Task[Any, Any]:
    """Return the task of some settings."""
    # By name: the modules of the tasks import this one.
    module, _, name = settings.opens.partition(":")
    task: Task[Any, Any] = getattr(import_module(module), name)()
    return task


def load_of[Loaded: "Model"](load_by_name: Callable[..., Loaded], settings: Settings) -> Loaded:
    """Load a model by its name as the settings say. Raises what `load_by_name` raises."""
    model = settings.model
    return load_by_name(
        model.family,
        model.checkpoint,
        settings.machine.device,
        model.dtype,
        model.random_weights,
        model.weights_seed,
        **model.options,
    )


def with_source[Chosen: Settings](settings: Chosen, source: Source[Any]) -> Chosen:
    """Return the settings with those of a source that was fitted."""
    return settings.changed(source=source.settings) if source.settings != settings.source else settings


def check_fit(card: "ModelCard", settings: Settings, source: Source[Any]) -> None:
    """Raise UsageError if a model takes smaller batches, or needs what the source does not show."""
    # `auto` is measured after this check, and by `largest_batch` never exceeds the card.
    batch = settings.machine.batch if isinstance(settings.machine.batch, int) else 1
    if card.batch is not None and batch > card.batch:
        raise UsageError(
            f"--batch {batch} with {card.family}, which takes at most {card.batch} observations per call: more "
            f"would change its numbers; pass --batch {card.batch} and use --workers to go faster"
        )
    if lacking := source.example(source.instructions[0]).lacks(card.needs):
        raise UsageError(
            f"{card.family} reads {', '.join(lacking)}, which {settings.source.subject} do not show; observations "
            "have pictures and the state, in a scene also the intrinsics"
        )
