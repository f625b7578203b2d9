"""The names that tables of a study file use of each other, and those that there are not."""

from collections.abc import Iterable, Iterator

from probe_kit.extract.parts import SCRIPTED
from probe_kit.hooks.registry import family_names
from probe_kit.study.mistakes import Mistake, Place, unknown
from probe_kit.study.planned_suite import PlannedSuite, slugs
from probe_kit.study.schema import Study

Use = tuple[Place, str, Iterable[str]]
"""Path of a list or value, the kind of the names in it, and the names."""


def unknown_names(study: Study, suite: PlannedSuite) -> list[Mistake]:
    """Return a mistake for every name that no table of the file, the suite or probe_kit has."""
    names = {
        "family": [*family_names(), *SCRIPTED],
        "model": list(study.models),
        "condition": list(study.conditions),
        "ask": list(study.asks),
        "condition or ask": [*study.conditions, *study.asks],
        "block": [block.name for block in study.runs],
        "group": list(dict.fromkeys(group for model in study.models.values() for group in model.groups)),
        "comparison": list(study.comparisons),
        "drift": list(study.drift),
        "category": list(suite.items),
    }
    return [
        Mistake(path, unknown(kind, name, names[kind]))
        for path, kind, uses in _uses(study)
        if kind != "category" or suite.items  # a suite that cannot be read has none
        for name in uses
        if name not in names[kind]
    ]


def _uses(study: Study) -> Iterator[Use]:
    yield ("suite", "categories"), "category", slugs(study.suite.categories or ())
    for name, model in study.models.items():
        yield ("models", name, "family"), "family", [model.family]
        for part in ("vlm", "finetuned_from", "untrained"):
            yield ("models", name, part), "model", [target] if (target := getattr(model, part)) else []
    for position, block in enumerate(study.runs):
        path = ("runs", position)
        yield (*path, "models"), "model", block.models
        yield (*path, "conditions"), "condition", block.conditions or ()
        yield (*path, "asks"), "ask", block.asks or ()
        yield (*path, "categories"), "category", slugs(block.categories or ())
    for name, probes in study.probes.items():
        yield ("probes", name, "runs"), "block", probes.runs
    for name, comparison in study.comparisons.items():
        if comparison.pairs is not None:
            yield ("comparisons", name, "pairs"), "condition or ask", comparison.pairs.conditions
            yield ("comparisons", name, "pairs"), "model", comparison.pairs.models
        yield ("comparisons", name, "chain"), "model", comparison.chain or ()
        yield ("comparisons", name, "groups"), "group", comparison.groups or ()
    for name, drift in study.drift.items():
        models = dict.fromkeys(side.partition("/")[0] for pair in drift.pairs for side in pair)
        yield ("drift", name, "pairs"), "model", models
    for name, table in study.tables.items():
        yield ("tables", name, "runs"), "block", table.runs or ()
        yield ("tables", name, "categories"), "category", slugs(table.categories or ())
        yield ("tables", name, "comparison"), "comparison", [table.comparison] if table.comparison else []
        yield ("tables", name, "drift"), "drift", [table.drift] if table.drift else []
        if table.elsewhere is not None:
            yield ("tables", name, "elsewhere"), "model", table.elsewhere.values
    for name, figure in study.figures.items():
        yield ("figures", name, "runs"), "block", figure.runs
        yield ("figures", name, "categories"), "category", slugs(figure.categories or ())
