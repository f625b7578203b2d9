"""Checks of a study file that its schema cannot make: names of other tables, and what does not fit together."""

from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.contract.options import check_options
from probe_kit.hooks.registry import family_names, find_family, get_family
from probe_kit.statistics.label_permutations import smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study.expansion import excludes, members
from probe_kit.study.mistakes import Mistake, each_unknown, unknown
from probe_kit.study.planned_suite import PlannedSuite, slug, slugs
from probe_kit.study.schema import BlockTable, ModelTable, Study
from probe_kit.suite.categories import check_slug

FEWEST_ITEMS = 10
"""Items of a category that five folds need, where every group is a pair of counterparts."""
_SCRIPTED = ("expert", "expert-mirrored", "idle")
_NEEDS = {
    "ablation": "comparison",
    "groups": "comparison",
    "chain": "comparison",
    "drift": "drift",
}
"""By kind of table, the field that names what it shows; other kinds need `runs`."""


def reference_mistakes(study: Study, suite: PlannedSuite) -> list[Mistake]:
    """Everything that is wrong with the names of a file, in the order of its tables."""
    checks: tuple[Callable[[Study, PlannedSuite], Iterator[Mistake]], ...] = (
        _suite, _reuse, _models, _lineages, _blocks, _excludes, _unused, _probes, _comparisons, _drift,
        _tables, _figures,
    )  # fmt: skip
    return [mistake for check in checks for mistake in check(study, suite)]


def _suite(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name in study.suite.counts:
        try:
            check_slug(slug(name))
        except ProbeKitError as error:
            yield Mistake(("suite", "counts", name), str(error))
    yield from _categories(("suite", "categories"), study.suite.categories, suite)
    yield from _items(("suite", "items"), study.suite.items, suite, study.suite.categories)


def _reuse(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for folder in study.reuse.folders:
        if not Path(folder).is_dir():
            yield Mistake(
                ("reuse", "folders"), f"there is no folder {folder!r}; name folders of runs, or leave it out"
            )


def _categories(path: tuple[str | int, ...], names: list[str] | None, suite: PlannedSuite) -> Iterator[Mistake]:
    if suite.items:
        yield from each_unknown(path, "category", slugs(names or ()), list(suite.items))


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
        if model.family not in families and model.family not in _SCRIPTED:
            yield Mistake((*place, "family"), unknown("family", model.family, [*families, *_SCRIPTED]))
            continue
        if model.family in families and not model.unavailable:
            yield from _option_mistakes(name, model)
        if model.weights_seed and not model.random_weights:
            yield Mistake((*place, "weights_seed"), "belongs to random weights; add random_weights = true")
        for part in ("vlm", "finetuned_from", "untrained"):
            target = getattr(model, part)
            if target is not None and target not in study.models:
                yield Mistake((*place, part), unknown("model", target, list(study.models)))
            elif target is not None:
                yield from _relation(study, name, part, target)


def _option_mistakes(name: str, model: ModelTable) -> Iterator[Mistake]:
    try:
        check_options(model.family, find_family(model.family).options, model.options)
    except ProbeKitError as error:
        yield Mistake(("models", name, "options"), str(error))


def _relation(study: Study, name: str, part: str, target: str) -> Iterator[Mistake]:
    model, other, place = study.models[name], study.models[target], ("models", name, part)
    if part == "vlm" and not _answers(other):
        yield Mistake(place, f"{target!r} ({other.family}) does not answer questions; name a VLM")
    if part == "untrained" and (other.family != model.family or not other.random_weights):
        said = f"{target!r} must be of family {model.family} with random_weights = true"
        yield Mistake(place, said)


def _answers(model: ModelTable) -> bool:
    family = get_family(model.family)
    return family is not None and family.reads


def _acts(model: ModelTable) -> bool:
    family = get_family(model.family)
    return model.family in _SCRIPTED or (family is not None and family.acts)


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
            yield Mistake(place, "give either conditions, for policies, or asks, for VLMs")
        yield from each_unknown((*place, "models"), "model", block.models, list(study.models))
        for part, known in (("conditions", study.conditions), ("asks", study.asks)):
            yield from each_unknown((*place, part), part[:-1], getattr(block, part) or (), list(known))
        yield from _kinds(study, block, place)
        yield from _categories((*place, "categories"), block.categories, suite)
        yield from _items((*place, "items"), block.items, suite, block.categories or study.suite.categories)
        if block.conditions and block.tokens == "none":
            yield Mistake((*place, "tokens"), "a policy's run stores pooled or all tokens; none is for asks")


def _kinds(study: Study, block: BlockTable, place: tuple[str | int, ...]) -> Iterator[Mistake]:
    for name in block.models:
        model = study.models.get(name)
        if model is None or (model.family not in family_names() and model.family not in _SCRIPTED):
            continue
        if block.conditions and not _acts(model):
            yield Mistake((*place, "models"), f"{name!r} ({model.family}) does not act; ask it, with asks")
        if block.asks and not _answers(model):
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
                yield Mistake(("runs", at, "exclude"), f"{said} excludes no run of block {block.name!r}")


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
                yield Mistake((home, name), "is in no run; use it in a block, or remove it")


# -- what is made of the runs ------------------------------------------------------------------------------------


def _block_names(study: Study) -> list[str]:
    return [block.name for block in study.runs]


def _probes(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, table in study.probes.items():
        place = ("probes", name)
        yield from each_unknown((*place, "runs"), "block", table.runs, _block_names(study))
        for block in (study.block(one) for one in table.runs if one in _block_names(study)):
            if block.asks and (block.tokens or "none") == "none":
                yield Mistake(
                    (*place, "runs"), f"block {block.name!r} asks with tokens none, which leaves nothing to probe"
                )
            yield from _enough_items(study, block, suite, (*place, "runs"))
            chosen = block.categories or study.suite.categories or list(suite.items)
            least = smallest_p(table.permutations) * len(chosen)
            if table.permutations and least > SIGNIFICANCE:
                needed = round(len(chosen) / SIGNIFICANCE) - 1
                yield Mistake(
                    (*place, "permutations"),
                    f"{table.permutations} are too few for {len(chosen)} categories: no corrected p can be below "
                    f"{least:.2f}. Give at least {needed}",
                )
        if "untrained" in table.controls:
            yield from _without_control(study, table.runs, place)


def _enough_items(
    study: Study, block: BlockTable, suite: PlannedSuite, place: tuple[str | int, ...]
) -> Iterator[Mistake]:
    asked = block.items or study.suite.items
    few = [
        name
        for name in slugs(block.categories or study.suite.categories or list(suite.items))
        if name in suite.items and min(asked or suite.items[name], suite.items[name]) < FEWEST_ITEMS
    ]
    if few:
        said = f"block {block.name!r} has fewer than {FEWEST_ITEMS} items of {', '.join(few)}"
        yield Mistake(place, f"{said}, which are too few groups for five folds")


def _without_control(study: Study, runs: list[str], place: tuple[str, str]) -> Iterator[Mistake]:
    played = {one.model for one in members(study)}
    for block in (study.block(one) for one in runs if one in _block_names(study)):
        for name in block.models:
            model = study.models.get(name)
            if model is None or model.unavailable or model.random_weights:
                continue
            if model.untrained is None:
                yield Mistake((*place, "controls"), f"{name!r} names no untrained network; add `untrained` to it")
            elif model.untrained not in played:
                yield Mistake((*place, "controls"), f"{model.untrained!r}, the control of {name!r}, is in no run")


def _comparisons(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    groups = list(dict.fromkeys(group for model in study.models.values() for group in model.groups))
    for name, table in study.comparisons.items():
        place = ("comparisons", name)
        if sum(part is not None for part in (table.pairs, table.chain, table.groups)) != 1:
            yield Mistake(place, "give exactly one of pairs, chain and groups")
        if table.pairs is not None:
            known = [*study.conditions, *study.asks]
            yield from each_unknown((*place, "pairs"), "condition or ask", table.pairs.conditions, known)
            yield from each_unknown((*place, "pairs"), "model", table.pairs.models, list(study.models))
            yield from _missing_pairs(study, table.pairs.models, table.pairs.conditions, (*place, "pairs"))
        yield from each_unknown((*place, "chain"), "model", table.chain or (), list(study.models))
        yield from each_unknown((*place, "groups"), "group", table.groups or (), groups)


def _missing_pairs(
    study: Study, models: list[str], ways: list[str], place: tuple[str | int, ...]
) -> Iterator[Mistake]:
    planned = {(one.model, one.way) for one in members(study)}
    known = [*study.conditions, *study.asks]
    for model in models:
        for way in ways:
            if model in study.models and way in known and (model, way) not in planned:
                yield Mistake(place, f"no block plays {model!r} in {way!r}")


def _drift(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    planned = {(one.model, one.way) for one in members(study)}
    acted = {one.model for one in members(study) if one.block.conditions}
    for name, table in study.drift.items():
        for side in (one for pair in table.pairs for one in pair):
            model, _slash, way = side.partition("/")
            place = ("drift", name, "pairs")
            if model not in study.models:
                yield Mistake(place, unknown("model", model, list(study.models)))
            elif way and (model, way) not in planned:
                yield Mistake(place, f"no block makes the run {side!r}")
            elif not way and model not in acted:
                yield Mistake(place, f"{model!r} is asked in several ways; name one, as `{model}/ASK`")


def _tables(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, table in study.tables.items():
        place = ("tables", name)
        yield from each_unknown((*place, "runs"), "block", table.runs or (), _block_names(study))
        yield from _categories((*place, "categories"), table.categories, suite)
        needed = _NEEDS.get(table.kind, "runs")
        if getattr(table, needed) is None:
            yield Mistake(place, f"a table of kind {table.kind!r} needs `{needed}`")
        for part, known in (("comparison", study.comparisons), ("drift", study.drift)):
            named = getattr(table, part)
            if named is not None and named not in known:
                yield Mistake((*place, part), unknown(part, named, list(known)))
        yield from _kind_of_comparison(study, name)
        if table.elsewhere is not None:
            yield from each_unknown((*place, "elsewhere"), "model", table.elsewhere.values, list(study.models))
            if table.kind != "score":
                said = f"numbers from elsewhere stand in tables of kind 'score', not {table.kind!r}"
                yield Mistake((*place, "elsewhere"), said)


def _figures(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, figure in study.figures.items():
        yield from each_unknown(("figures", name, "runs"), "block", figure.runs, _block_names(study))
        yield from _categories(("figures", name, "categories"), figure.categories, suite)


_SHOWS = {"ablation": "pairs", "chain": "chain", "groups": "groups"}
"""By kind of table, the kind of comparison it shows."""


def _kind_of_comparison(study: Study, name: str) -> Iterator[Mistake]:
    table = study.tables[name]
    wanted, comparison = _SHOWS.get(table.kind), study.comparisons.get(table.comparison or "")
    if wanted and comparison is not None and getattr(comparison, wanted) is None:
        said = f"{table.comparison!r} has no {wanted}, which a table of kind {table.kind!r} shows"
        yield Mistake(("tables", name, "comparison"), said)
