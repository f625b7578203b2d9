"""Expansion of a study file into its cells."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.errors import ProbeKitError
from probe_kit.extract.parts import SCRIPTED, ModelSettings
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.hooks.registry import get_family
from probe_kit.study.cells import ItemSelection, PlannedRun, PlannedSuite, slugs
from probe_kit.study.schema import BlockTable, ConditionTable, Mistake, ModelTable, Place, Study


def answers(model: ModelTable) -> bool:
    """Whether the model is a VLM."""
    family = get_family(model.family)
    return family is not None and family.abilities.reads


def acts(model: ModelTable) -> bool:
    """Whether the model is a policy."""
    family = get_family(model.family)
    return model.family in SCRIPTED or (family is not None and family.abilities.acts)


@dataclass(frozen=True)
class Member:
    """A run that a block asks for.

    Attributes:
        position: Position of the block in the file.
        way: Name of the condition or the ask.
    """

    block: BlockTable
    position: int
    model: str
    way: str
    seed: int

    @property
    def asks(self) -> bool:
        """Whether a VLM is asked."""
        return self.block.asks is not None

    @property
    def run(self) -> tuple[str, str, int]:
        """Model, condition or ask, and seed, which distinguish runs."""
        return self.model, self.way, self.seed

    @property
    def path(self) -> Place:
        """The path of the list that names its condition or ask."""
        return ("runs", self.position, "conditions" if self.block.conditions else "asks")


def members(study: Study) -> Iterator[Member]:
    """Yield the runs that blocks ask for, excludes left out, in the order of the file."""
    for position, block in enumerate(study.runs):
        for model in block.models:
            for way in block.conditions or block.asks or ():
                if not any(excludes(rule.model_dump(exclude_none=True), model, way) for rule in block.exclude):
                    yield from (Member(block, position, model, way, seed) for seed in block.seeds)


def runs_of_side[Run: (Member, PlannedRun)](runs: Sequence[Run], side: str) -> list[Run]:
    """Return the runs of one side of a drift pair: of a model's first condition, or of that after the slash."""
    model, _, way = side.partition("/")
    of_model = [run for run in runs if run.model == model and (run.way == way if way else not run.asks)]
    return [run for run in of_model if run.way == of_model[0].way]


def excludes(rule: dict[str, str], model: str, way: str) -> bool:
    """Whether an exclude leaves out a model in a condition or ask."""
    names = {"model": model, "condition": way, "ask": way}
    return all(names[part] == value for part, value in rule.items())


def categories_of(study: Study, block: BlockTable, suite: PlannedSuite) -> tuple[str, ...]:
    """Return the slugs of a block's categories: its own, else the file's, else all of the suite."""
    return slugs(block.categories or study.suite.categories or list(suite.items))


def expand(study: Study, suite: PlannedSuite) -> tuple[list[PlannedRun], list[Mistake]]:
    """Return the cells of a study without wrong names, and mistakes that only their settings show.

    Blocks that ask for the same run share its cell.
    """
    cells: dict[tuple[str, str, int], PlannedRun] = {}
    mistakes: list[Mistake] = []
    for member in members(study):
        if not (answers if member.block.asks else acts)(study.models[member.model]):
            continue  # which is a mistake of its block
        try:
            settings = _settings(study, member)
        except ProbeKitError as error:
            mistakes.append(Mistake(_blamed_place(study, member, str(error)), str(error)))
            continue
        try:
            settings.scene.to_json()
        except ProbeKitError as error:  # of the one file that a scene is drawn with
            mistakes.append(Mistake(("conditions", member.way, "background"), str(error)))
            continue
        block = member.block
        selections = {
            block.name: ItemSelection(categories_of(study, block, suite), block.items or study.suite.items)
        }
        cell = cells.get(member.run)
        if cell is None:
            unavailable = study.models[member.model].unavailable or ""
            cells[member.run] = PlannedRun(*member.run, settings, selections, suite, unavailable)
        elif cell.settings != settings:
            text = f"{cell.name} is already planned by block {next(iter(cell.selections))!r} with other settings"
            mistakes.append(Mistake(member.path, f"{text}; give both blocks the same tokens"))
        else:
            cells[member.run] = replace(cell, selections={**cell.selections, **selections})
    every = list(cells.values())
    mistakes += [*_same_settings(every), *_without_control(study, every)]
    return every, list(dict.fromkeys(mistakes))  # every run of a wrong table repeats its mistake


def _blamed_place(study: Study, member: Member, message: str) -> Place:
    """Return the table whose values a settings error is about, and the key in it that the message names."""
    home, name = "asks" if member.asks else "conditions", member.way
    # If the model's settings are wrong even in a condition without values, the model is to blame.
    try:
        _settings_of(study, member.model, ConditionTable(), None)
    except ProbeKitError:
        home, name = "models", member.model
    fields = getattr(study, home)[name].model_fields_set
    in_message = [word for word in re.findall(r"\w+", message) if word in fields]
    return (home, name, *in_message[:1])


def _settings(study: Study, member: Member) -> Settings:
    if member.block.asks:
        ask = AskSettings(**_common(study, member.model), **study.asks[member.way].model_dump())
        return ask.changed(tokens=member.block.tokens or "none", seed=member.seed)
    settings = _settings_of(study, member.model, study.conditions[member.way], member.block.tokens)
    return settings.changed(seed=member.seed)


def _common(study: Study, name: str) -> dict[str, Any]:
    model = study.models[name]
    weights = {field: getattr(model, field) for field in ModelSettings.model_fields if field != "family"}
    # A protocol has its own scene; the study's is for models that name neither.
    scene = model.scene or (None if model.protocol else study.scene)
    device = "cuda" if model.gpus else "cpu"
    of_model = {"model": model.family, **weights, "protocol": model.protocol, "batch": model.batch}
    return {**of_model, "scene": scene, "device": device}


def _settings_of(study: Study, name: str, condition: ConditionTable, tokens: str | None) -> ExtractSettings:
    """Return the settings of a policy, completed by its protocol."""
    of_model, of_condition = _common(study, name), dict(condition)
    scene, capture_only = of_condition.pop("scene") or of_model["scene"], of_condition.pop("no_act")
    return ExtractSettings(
        **{**of_model, **of_condition, "scene": scene, "capture_only": capture_only},
        execute=study.models[name].execute,
        tokens=tokens or "pooled",
    ).followed()


def _same_settings(cells: list[PlannedRun]) -> list[Mistake]:
    """Return a mistake for conditions or asks that are the same for a model under two names."""
    mistakes = []
    for at, cell in enumerate(cells):
        for other in cells[:at]:
            alike = (cell.model, cell.seed, cell.settings) == (other.model, other.seed, other.settings)
            if alike and cell.way != other.way:
                home = "asks" if cell.asks else "conditions"
                text = f"is the same as {other.way!r} for {cell.model!r}: all values are equal"
                text = f"{text}. Leave one out, or exclude it for this model"
                mistakes.append(Mistake((home, cell.way), text))
    return mistakes


def control_of(study: Study, cells: Sequence[PlannedRun], cell: PlannedRun) -> PlannedRun | None:
    """Return the run of a policy's untrained network that its probes are compared with; None without a network.

    It is in the same condition, or else of the same scene and seed. Whether a network then acts changes nothing in
    the activations that were captured before.
    """
    of_network = [
        other for other in cells if other.model == study.models[cell.model].untrained and other.seed == cell.seed
    ]
    same = (other for other in of_network if other.way == cell.way)
    alike = (
        other for other in of_network if other.asks == cell.asks and other.settings.scene == cell.settings.scene
    )
    return next(same, None) or next(alike, None)


def _without_control(study: Study, cells: list[PlannedRun]) -> Iterator[Mistake]:
    """Yield a mistake for probes whose untrained network is played in other scenes alone."""
    for name, table in study.probes.items():
        for cell in cells if "untrained" in table.controls else ():
            model = study.models[cell.model]
            probed = any(block in table.runs for block in cell.selections) and not cell.unavailable
            if probed and model.untrained is not None and control_of(study, cells, cell) is None:
                text = f"{model.untrained!r}, the control of {cell.name}, has no run in the same scene"
                text = f"{text}; play it so, or capture it so with no_act"
                yield Mistake(("probes", name, "controls"), text)
