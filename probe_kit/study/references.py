"""Checks of a study file that its schema cannot make: names of other tables, and what does not fit together.

Those of probes, comparisons, tables and figures are in `result_references`.
"""

from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.contract.options import check_options
from probe_kit.hooks.registry import family_names, find_family
from probe_kit.runs.store import SCHEMES
from probe_kit.study.expansion import SCRIPTED, acts, answers, excludes, is_known, members
from probe_kit.study.mistakes import Mistake, each_unknown
from probe_kit.study.planned_suite import PlannedSuite, slug, slugs
from probe_kit.study.result_references import category_mistakes, result_mistakes
from probe_kit.study.schema import BlockTable, ModelTable, Study
from probe_kit.suite.categories import check_slug

_RESERVED = "ledger"
"""Of the ledger's folder, which lies beside those of models."""


def reference_mistakes(study: Study, suite: PlannedSuite) -> list[Mistake]:
    """Everything that is wrong with the names of a file, in the order of its tables."""
    checks: tuple[Callable[[Study, PlannedSuite], Iterator[Mistake]], ...] = (
        _places, _suite, _models, _labels, _lineages, _blocks, _excludes, _unused, result_mistakes,
    )  # fmt: skip
    return [mistake for check in checks for mistake in check(study, suite)]


def _places(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    scheme, is_url, _rest = study.folder.partition("://")
    if is_url and scheme not in SCHEMES:
        yield Mistake(("out",), f"runs lie in folders or at {', '.join(f'{one}://' for one in SCHEMES)}")
    for folder in study.reuse.folders:
        if not Path(folder).is_dir():
            yield Mistake(
                ("reuse", "folders"), f"there is no folder {folder!r}; name folders of runs, or leave it out"
            )
        elif Path(folder).resolve() == Path(study.folder).resolve():
            said = f"{folder!r} is the study's own folder, whose runs are found without it; name other folders"
            yield Mistake(("reuse", "folders"), said)


def _suite(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    counts = list(study.suite.counts)
    if counts and study.suite.path is None:
        yield Mistake(("suite", "counts"), "belongs to a suite of your own; give its `path`, or leave it out")
    for at, name in enumerate(counts):
        place = ("suite", "counts", name)
        if slug(name) in slugs(counts[:at]):
            yield Mistake(place, f"{slug(name)} is counted twice; name each category once")
        try:
            check_slug(slug(name))
        except ProbeKitError as error:
            yield Mistake(place, str(error))
    yield from category_mistakes(("suite", "categories"), study.suite.categories, suite)
    yield from _items(("suite", "items"), study.suite.items, suite, study.suite.categories)


def _items(
    path: tuple[str | int, ...], items: int | None, suite: PlannedSuite, categories: list[str] | None
) -> Iterator[Mistake]:
    few = [
        f"{name} has {suite.items[name]}"
        for name in slugs(categories or list(suite.items))
        if items is not None and suite.items.get(name, items) < items
    ]
    if few:
        yield Mistake(path, f"{items} items are asked for, and {', '.join(few)}")


# -- models ------------------------------------------------------------------------------------------------------


def _models(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    families = family_names()
    for name, model in study.models.items():
        place = ("models", name)
        if name == _RESERVED:
            yield Mistake(place, "is the name of the ledger's folder; give the model another")
        if not is_known(model):
            yield from each_unknown((*place, "family"), "family", [model.family], [*families, *SCRIPTED])
            continue
        if model.family in families and not model.unavailable:
            yield from _option_mistakes(name, model)
        if model.weights_seed and not model.random_weights:
            yield Mistake((*place, "weights_seed"), "belongs to random weights; add random_weights = true")
        for part in ("vlm", "finetuned_from", "untrained"):
            target = getattr(model, part)
            if target is not None and target not in study.models:
                yield from each_unknown((*place, part), "model", [target], list(study.models))
            elif target is not None:
                yield from _relation(study, name, part, target)


def _labels(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    """Tables tell systems apart by their labels."""
    of: dict[str, str] = {}
    for name, model in study.models.items():
        label = model.label or name
        if (other := of.setdefault(label, name)) != name:
            place = ("models", name, *(["label"] if model.label else []))
            yield Mistake(place, f"{other!r} is called {label!r} too; give each model a label of its own")


def _option_mistakes(name: str, model: ModelTable) -> Iterator[Mistake]:
    try:
        check_options(model.family, find_family(model.family).options, model.options)
    except ProbeKitError as error:
        yield Mistake(("models", name, "options"), str(error))


def _relation(study: Study, name: str, part: str, target: str) -> Iterator[Mistake]:
    model, other, place = study.models[name], study.models[target], ("models", name, part)
    if part == "vlm" and is_known(other) and not answers(other):
        yield Mistake(place, f"{target!r} ({other.family}) does not answer questions; name a VLM")
    if part == "untrained" and (other.family != model.family or not other.random_weights):
        said = f"{target!r} must be of family {model.family} with random_weights = true"
        yield Mistake(place, said, absent=not other.random_weights)


def _lineages(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for part in ("vlm", "finetuned_from", "untrained"):
        graph = {name: {target} for name, model in study.models.items() if (target := getattr(model, part))}
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            circle = error.args[1]
            yield Mistake(("models", circle[0], part), f"runs in a circle: {' → '.join(circle)}")


# -- blocks ------------------------------------------------------------------------------------------------------


def _blocks(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    names = [block.name for block in study.runs]
    for at, block in enumerate(study.runs):
        place = ("runs", at)
        if block.name in names[:at]:
            yield Mistake((*place, "name"), f"a block is already called {block.name!r}; give each its own name")
        if (block.conditions is None) == (block.asks is None):
            yield Mistake(place, "give either conditions, for policies, or asks, for VLMs", absent=True)
        yield from each_unknown((*place, "models"), "model", block.models, list(study.models))
        for part, known in (("conditions", study.conditions), ("asks", study.asks)):
            yield from each_unknown((*place, part), part[:-1], getattr(block, part) or (), list(known))
        yield from _kinds(study, block, place)
        yield from category_mistakes((*place, "categories"), block.categories, suite)
        yield from _items((*place, "items"), block.items, suite, block.categories or study.suite.categories)
        if block.conditions and block.tokens == "none":
            yield Mistake((*place, "tokens"), "a policy's run stores pooled or all tokens; none is for asks")


def _kinds(study: Study, block: BlockTable, place: tuple[str | int, ...]) -> Iterator[Mistake]:
    for name in block.models:
        model = study.models.get(name)
        if model is None or not is_known(model):
            continue
        if block.conditions and not acts(model):
            yield Mistake((*place, "models"), f"{name!r} ({model.family}) does not act; ask it, with asks")
        if block.asks and not answers(model):
            said = f"{name!r} ({model.family}) answers no questions; play it, with conditions"
            yield Mistake((*place, "models"), said)


def _excludes(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for at, block in enumerate(study.runs):
        ways = block.conditions or block.asks or []
        for rule in block.exclude:
            given = rule.model_dump(exclude_none=True)
            strange = "ask" if block.conditions else "condition"
            matched = any(excludes(given, model, way) for model in block.models for way in ways)
            if not given or strange in given or not matched:
                said = ", ".join(f"{part} {value!r}" for part, value in given.items()) or "nothing named"
                said = f"{said} excludes no run of block {block.name!r}"
                yield Mistake(("runs", at, "exclude"), said, absent=True)


def _unused(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    used = list(members(study))
    twins = {model.untrained for model in study.models.values()}
    for home, names, seen in (
        ("models", study.models, {one.model for one in used} | twins),
        ("conditions", study.conditions, {one.way for one in used if one.block.conditions}),
        ("asks", study.asks, {one.way for one in used if one.block.asks}),
    ):
        for name in names:
            if name not in seen:
                yield Mistake((home, name), "is in no run; use it in a block, or remove it", absent=True)
