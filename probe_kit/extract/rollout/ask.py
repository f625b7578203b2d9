"""The task ask: a model answers a question about the first observation of every row."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from probe_kit.errors import UsageError
from probe_kit.extract.plan import Row
from probe_kit.extract.rollout.answer_controller import AnswerController
from probe_kit.extract.rollout.task import Fitted, Task, check_fit, load_of, with_source
from probe_kit.extract.settings import AskSettings
from probe_kit.extract.sources.source import Source
from probe_kit.extract.vqa.phrases import phrases

if TYPE_CHECKING:
    from probe_kit.hooks import AnswerModel
    from probe_kit.hooks.family import Family


class Ask(Task[AskSettings, "AnswerModel"]):
    """A model answers one question a row, and its first inference may be captured."""

    names_all_items = True  # an object that is asked for may be that of any item

    def check_family(self, settings: AskSettings, family: "Family | None") -> None:
        """Raise UsageError for a model that acts."""
        if family is None or not family.reads:
            from probe_kit.hooks.registry import known_families

            reads = [name for name, candidate in known_families().items() if candidate.reads]
            raise UsageError(
                f"{settings.model.family} acts and does not answer questions; those that do: {', '.join(reads)}"
            )

    def view_of(self, source: Source[Any]) -> Source[Any]:
        """Return the source with a row per question."""
        return source.for_questions()

    def rows(self, settings: AskSettings, source: Source[Any]) -> tuple[Row, ...]:
        """Return the rows with what a question asks for, where that is not the object of the instruction.

        Raises UsageError for items without such a phrase.
        """
        rows = source.rows(settings.seed)
        if settings.task.query == "target" or source.suite is None:
            return rows
        by_item = phrases(source.suite, settings.task.query, settings.seed)
        objects = {item: phrase.with_article for item, phrase in by_item.items()}
        return tuple(
            replace(row, columns={**row.columns, "asked_object": objects[row.columns["item_id"]]}) for row in rows
        )

    def texts(self, settings: AskSettings, source: Source[Any]) -> Iterable[str]:
        """Return the objects that are asked for, or the instructions of a source without objects."""
        if source.suite is None:
            return source.instructions
        objects = phrases(source.suite, settings.task.query, settings.seed)
        return dict.fromkeys(phrase.text for phrase in objects.values())

    def load(self, settings: AskSettings) -> "AnswerModel":
        """Load the model that is asked. Raises UsageError if it answers no questions, and as `load_model`."""
        from probe_kit.hooks import AnswerModel, load_model

        model = load_of(load_model, settings)
        if not isinstance(model, AnswerModel):
            raise UsageError(
                f"{settings.model.family} returned a {type(model).__name__}, not a AnswerModel; fix the loader"
            )
        return model

    def fit(self, settings: AskSettings, source: Source[Any], model: "AnswerModel | None") -> Fitted:
        """Show the source to the model, and choose how its answers are read."""
        assert model is not None, "no script answers"
        source = source.watched(model.card.cameras)
        settings = with_source(settings, source)
        check_fit(model.card, settings, source)
        return settings, source, AnswerController(model, source, settings), None
