"""Expansion of a study file into its cells."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from probe_kit.errors import ProbeKitError
from probe_kit.extract.settings import AskSettings, ExtractSettings, Settings
from probe_kit.hooks.registry import family_names, get_family
from probe_kit.study.cells import Cell, Selection
from probe_kit.study.mistakes import Mistake, Place
from probe_kit.study.planned_suite import PlannedSuite, slugs
from probe_kit.study.schema import AskTable, BlockTable, ConditionTable, ModelTable, Study

SCRIPTED = ("expert", "expert-mirrored", "idle")
"""Policies without a network, which stand in place of a family."""


def is_known(model: ModelTable) -> bool:
    """Whether there is such a family."""
    return model.family in SCRIPTED or model.family in family_names()


def answers(model: ModelTable) -> bool:
    """Whether the model is a VLM."""
    family = get_family(model.family)
    return family is not None and family.reads


def acts(model: ModelTable) -> bool:
    """Whether the model is a policy."""
    family = get_family(model.family)
    return model.family in SCRIPTED or (family is not None and family.acts)


@dataclass(frozen=True)
class Member:
    """A run that a block asks for. place: of the block in the file."""

    block: BlockTable
    place: int
    model: str
    way: str
    seed: int

    @property
    def path(self) -> Place:
        """Of the list that names its condition or ask."""
        return ("runs", self.place, "conditions" if self.block.conditions else "asks")


def members(study: Study) -> Iterator[Member]:
    """The runs that blocks ask for, excludes left out, in the order of the file."""
    for place, block in enumerate(study.runs):
        for model in block.models:
            for way in block.conditions or block.asks or ():
                if not any(excludes(rule.model_dump(exclude_none=True), model, way) for rule in block.exclude):
                    yield from (Member(block, place, model, way, seed) for seed in block.seeds)


def excludes(rule: dict[str, str], model: str, way: str) -> bool:
    """Whether an exclude leaves out a model in a condition or ask."""
    names = {"model": model, "condition": way, "ask": way}
    return all(names[part] == value for part, value in rule.items())


def expand(
    study: Study, suite: PlannedSuite, known_mistakes: Sequence[Mistake] = ()
) -> tuple[list[Cell], list[Mistake]]:
    """The cells of a study, and mistakes that only their settings show.

    Blocks that ask for the same run share its cell.
    known_mistakes: of the file; runs of their tables are left out.
    """
    found: dict[tuple[str, str, int], Cell] = {}
    mistakes: list[Mistake] = []
    wrong = {one.path[:length] for one in known_mistakes if not one.absent for length in (2, 3)}
    for member in (one for one in members(study) if _can_be_made(study, one, wrong)):
        try:
            settings = _settings(study, member)
        except ProbeKitError as error:
            mistakes.append(Mistake(_blamed(study, member, str(error)), str(error)))
            continue
        try:
            settings.scene.to_json()
        except ProbeKitError as error:  # of the one file that a scene is drawn with
            mistakes.append(Mistake(("conditions", member.way, "background"), str(error)))
            continue
        selection = _selection(study, member.block, suite)
        place = (member.model, member.way, member.seed)
        known = found.get(place)
        if known is None:
            unavailable = study.models[member.model].unavailable or ""
            selections = {member.block.name: selection}
            cell = Cell(member.model, member.way, member.seed, settings, selections, suite, unavailable)
            found[place] = cell
        elif known.settings != settings:
            said = f"{known.name} is already planned by block {next(iter(known.selections))!r} with other settings"
            mistakes.append(Mistake(member.path, f"{said}; give both blocks the same tokens"))
        else:
            found[place] = replace(known, selections={**known.selections, member.block.name: selection})
    mistakes += [*_same_settings(list(found.values())), *_without_control(study, list(found.values()))]
    return list(found.values()), list(dict.fromkeys(mistakes))


def _can_be_made(study: Study, member: Member, wrong: set[Place]) -> bool:
    """Whether the names of a run are known and nothing is wrong with its model and its condition or ask."""
    model, (home, ways) = study.models.get(member.model), _ways(study, member)
    concerned: set[Place] = {("models", member.model), (home, member.way), ("runs", member.place, "tokens")}
    if model is None or member.way not in ways or wrong & concerned:
        return False
    return answers(model) if member.block.asks else acts(model)


def _ways(study: Study, member: Member) -> tuple[str, Mapping[str, ConditionTable | AskTable]]:
    """The tables that hold its condition or ask, and their name."""
    return ("asks", study.asks) if member.block.asks else ("conditions", study.conditions)


def _selection(study: Study, block: BlockTable, suite: PlannedSuite) -> Selection:
    categories = block.categories or study.suite.categories or list(suite.items)
    return Selection(slugs(categories), block.items or study.suite.items)


def _blamed(study: Study, member: Member, said: str) -> Place:
    """The table whose values a settings error is of, and the key in it that the message names."""
    home, name = _ways(study, member)[0], member.way
    try:
        _settings_of(study, member.model, ConditionTable(), None)
    except ProbeKitError:
        home, name = "models", member.model
    given = getattr(study, home)[name].model_fields_set
    named = [word for word in re.findall(r"\w+", said) if word in given]
    return (home, name, *named[:1])


def _settings(study: Study, member: Member) -> Settings:
    if member.block.asks:
        ask = study.asks[member.way]
        tokens = member.block.tokens or "none"
        return _asked(study, member.model, ask).changed(tokens=tokens, seed=member.seed)
    found = _settings_of(study, member.model, study.conditions[member.way], member.block.tokens)
    return found.changed(seed=member.seed)


def _common(study: Study, name: str) -> dict[str, Any]:
    model = study.models[name]
    return {
        "model": model.family,
        "checkpoint": model.checkpoint,
        "random_weights": model.random_weights,
        "weights_seed": model.weights_seed,
        "options": model.options,
        "protocol": model.protocol,
        "scene": _scene(study, model),
        "dtype": model.dtype,
        "batch": model.batch,
        "device": "cuda" if model.gpus else "cpu",
    }


def _scene(study: Study, model: ModelTable) -> str | None:
    """A protocol has its own scene; the study's is for models that name neither."""
    return model.scene or (None if model.protocol else study.scene)


def _settings_of(study: Study, name: str, condition: ConditionTable, tokens: str | None) -> ExtractSettings:
    """Of a policy, with what its protocol decides."""
    chosen = condition.model_dump(exclude={"no_act"})
    return ExtractSettings(
        **_common(study, name),
        **chosen,
        execute=study.models[name].execute,
        capture_only=condition.no_act,
        tokens=tokens or "pooled",
    ).followed()


def _asked(study: Study, name: str, ask: AskTable) -> AskSettings:
    return AskSettings(**_common(study, name), **ask.model_dump())


def _same_settings(cells: list[Cell]) -> list[Mistake]:
    """Conditions or asks that are the same for a model under two names."""
    found = []
    for at, cell in enumerate(cells):
        for other in cells[:at]:
            alike = (cell.model, cell.seed, cell.settings) == (other.model, other.seed, other.settings)
            if alike and cell.way != other.way:
                home = "asks" if cell.asks else "conditions"
                said = f"is the same as {other.way!r} for {cell.model!r}: all values are equal"
                said = f"{said}. Leave one out, or exclude it for this model"
                found.append(Mistake((home, cell.way), said, absent=True))
    return found


def control_of(study: Study, cells: Sequence[Cell], cell: Cell) -> Cell | None:
    """The run of a policy's untrained network that its probes are compared with; None without such a network.

    It is in the same condition, or else of the same scene and seed: whether a network then acts changes nothing in
    what was captured before.
    """
    own = [one for one in cells if one.model == study.models[cell.model].untrained and one.seed == cell.seed]
    same = (one for one in own if one.way == cell.way)
    alike = (one for one in own if one.asks == cell.asks and one.settings.scene == cell.settings.scene)
    return next(same, None) or next(alike, None)


def _without_control(study: Study, cells: list[Cell]) -> Iterator[Mistake]:
    """Probes that are to be compared with an untrained network that is played in other scenes alone."""
    for name, table in study.probes.items():
        for cell in cells if "untrained" in table.controls else ():
            model = study.models[cell.model]
            probed = any(block in table.runs for block in cell.selections) and not cell.unavailable
            if probed and model.untrained is not None and control_of(study, cells, cell) is None:
                said = f"{model.untrained!r}, the control of {cell.name}, has no run in the same scene"
                said = f"{said}; play it so, or capture it so with no_act"
                yield Mistake(("probes", name, "controls"), said, absent=True)
