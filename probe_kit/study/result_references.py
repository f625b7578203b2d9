"""Checks of what a study file makes of its runs: probes, comparisons, drift, tables and figures."""

from collections.abc import Callable, Iterable, Iterator, Mapping

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.contract.declared import DeclaredStream
from probe_kit.hooks.contract.views import resolve_view, view_names
from probe_kit.hooks.registry import get_family
from probe_kit.statistics.label_permutations import permutations_for, shortage, smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study.expansion import Member, members
from probe_kit.study.mistakes import Mistake, Place, each_unknown
from probe_kit.study.planned_suite import PlannedSuite, slugs
from probe_kit.study.schema import BlockTable, ModelTable, ProbesTable, Study, TableKind, TableTable

FEWEST_ITEMS = 10
"""Items of a category that five folds need, where every group is a pair of counterparts."""
_NEEDS: Mapping[TableKind, str] = {
    "ablation": "comparison",
    "groups": "comparison",
    "chain": "comparison",
    "drift": "drift",
}
"""By kind of table, the field that names what it shows; other kinds need `runs`."""
_SHOWS = {"ablation": "pairs", "chain": "chain", "groups": "groups"}
"""By kind of table, the kind of comparison it shows."""
_POOLED = ("mean", "last", "tokens")
_BY_ROLE = ("mean:", "tokens:")
"""What views of one role begin with."""


def result_mistakes(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    """What is wrong with the tables of a file that use runs, in the order of its tables."""
    checks: tuple[Callable[[Study, PlannedSuite], Iterator[Mistake]], ...] = (
        _probes, _comparisons, _drift, _tables, _figures,
    )  # fmt: skip
    for check in checks:
        yield from check(study, suite)


def category_mistakes(path: Place, names: list[str] | None, suite: PlannedSuite) -> Iterator[Mistake]:
    """Categories that the suite lacks."""
    if suite.items:
        yield from each_unknown(path, "category", slugs(names or ()), list(suite.items))


def _blocks(study: Study, names: Iterable[str]) -> list[BlockTable]:
    """The blocks of these names, as far as there are any."""
    return [block for block in study.runs if block.name in names]


def _unknown_blocks(path: Place, names: Iterable[str] | None, study: Study) -> list[Mistake]:
    return each_unknown(path, "block", names or (), [block.name for block in study.runs])


def _chosen(study: Study, block: BlockTable, suite: PlannedSuite) -> tuple[str, ...]:
    """The categories of a block."""
    return slugs(block.categories or study.suite.categories or list(suite.items))


# -- probes ------------------------------------------------------------------------------------------------------


def _probes(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    before: dict[tuple[str, str], str] = {}
    for name, table in study.probes.items():
        place = ("probes", name)
        yield from _unknown_blocks((*place, "runs"), table.runs, study)
        for block in _blocks(study, table.runs):
            if (other := before.setdefault((block.name, table.target), name)) != name:
                said = f"block {block.name!r} is probed by {other!r} too, and tables show one of both"
                yield Mistake((*place, "runs"), f"{said}; give one of them all views")
            if block.asks and not _stores(block):
                said = f"block {block.name!r} asks with tokens none, which leaves nothing to probe"
                yield Mistake((*place, "runs"), said)
            yield from _enough_items(study, block, suite, (*place, "runs"))
            yield from _enough_permutations(table, place)
            for model in (study.models[one] for one in block.models if one in study.models):
                yield from _views((*place, "views"), table.views, model)
        if "untrained" in table.controls:
            yield from _without_control(study, table, place)


def _stores(block: BlockTable) -> bool:
    """Whether a block of asks stores activations."""
    return (block.tokens or "none") != "none"


def _enough_items(study: Study, block: BlockTable, suite: PlannedSuite, place: Place) -> Iterator[Mistake]:
    asked = block.items or study.suite.items
    few = [
        name
        for name in _chosen(study, block, suite)
        if name in suite.items and min(asked or suite.items[name], suite.items[name]) < FEWEST_ITEMS
    ]
    if few:
        said = f"block {block.name!r} has fewer than {FEWEST_ITEMS} items of {', '.join(few)}"
        yield Mistake(place, f"{said}, which are too few groups for five folds", absent=True)


def _enough_permutations(table: ProbesTable, place: Place) -> Iterator[Mistake]:
    if table.permutations and shortage(smallest_p(table.permutations), table.permutations):
        message = f"{table.permutations} are too few: no p can be below {SIGNIFICANCE}. Give at least"
        yield Mistake((*place, "permutations"), f"{message} {permutations_for()}", absent=True)


def _views(place: Place, views: list[str], model: ModelTable) -> Iterator[Mistake]:
    """Views that no stream of a model has, or of which that is not known, that cannot be the name of one."""
    streams = _declared(model)
    known = [view for one in streams for view in view_names(one.roles)]
    for view in views:
        pooled = view.replace("tokens", "mean", 1)
        named = view in _POOLED or (view.startswith(_BY_ROLE) and view.partition(":")[2])
        if not named or (known and resolve_view(pooled, known) not in known):
            shown = ", ".join(dict.fromkeys(known)) or "mean, last, or mean:ROLE such as mean:language"
            said = f"{view!r} is no view of {model.family}; expected some of {shown}; tokens for every token"
            yield Mistake(place, said)


def _declared(model: ModelTable) -> tuple[DeclaredStream, ...]:
    """The streams that a family declares; none where it declares none, or the options are wrong."""
    family = get_family(model.family)
    try:
        return (family and family.declared_streams(model.options)) or ()
    except ProbeKitError:
        return ()


def _without_control(study: Study, table: ProbesTable, place: Place) -> Iterator[Mistake]:
    played = {one.model for one in members(study)}
    for block in _blocks(study, table.runs):
        for name in block.models:
            model = study.models.get(name)
            if model is None or model.unavailable or model.random_weights:
                continue
            said = ""
            if model.untrained is None:
                said = f"{name!r} names no untrained network; add `untrained` to it"
            elif model.untrained not in played:
                said = f"{model.untrained!r}, the control of {name!r}, is in no run"
            if said:
                yield Mistake((*place, "controls"), said, absent=True)


# -- comparisons -------------------------------------------------------------------------------------------------


def _comparisons(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    groups = list(dict.fromkeys(group for model in study.models.values() for group in model.groups))
    for name, table in study.comparisons.items():
        place = ("comparisons", name)
        if sum(part is not None for part in (table.pairs, table.chain, table.groups)) != 1:
            yield Mistake(place, "give exactly one of pairs, chain and groups", absent=True)
        if table.pairs is not None:
            known = [*study.conditions, *study.asks]
            yield from each_unknown((*place, "pairs"), "condition or ask", table.pairs.conditions, known)
            yield from each_unknown((*place, "pairs"), "model", table.pairs.models, list(study.models))
            yield from _missing_pairs(study, table.pairs.models, table.pairs.conditions, (*place, "pairs"))
        yield from each_unknown((*place, "chain"), "model", table.chain or (), list(study.models))
        yield from _without_common_condition(study, table.chain or [], (*place, "chain"))
        yield from each_unknown((*place, "groups"), "group", table.groups or (), groups)
        yield from _grouped(study, table.groups or [], (*place, "groups"))


def _missing_pairs(study: Study, models: list[str], ways: list[str], place: Place) -> Iterator[Mistake]:
    planned = {(one.model, one.way) for one in members(study)}
    known = [*study.conditions, *study.asks]
    for model in models:
        for way in ways:
            if model in study.models and way in known and (model, way) not in planned:
                yield Mistake(place, f"no block plays {model!r} in {way!r}", absent=True)


def _grouped(study: Study, names: list[str], place: Place) -> Iterator[Mistake]:
    """Models that are in several groups of a comparison, and groups without a condition that all have."""
    of = {name: [group for group in model.groups if group in names] for name, model in study.models.items()}
    for name, own in of.items():
        if len(own) > 1:
            yield Mistake(place, f"{name!r} is in {' and '.join(map(repr, own))}; groups have no model in common")
    yield from _without_common_condition(study, [name for name, own in of.items() if own], place)


def _without_common_condition(study: Study, models: list[str], place: Place) -> Iterator[Mistake]:
    """Models that were to be compared and are not played in one condition."""
    ways: dict[str, set[str]] = {name: set() for name in models if name in study.models}
    for one in members(study):
        if one.model in ways and one.block.conditions:
            ways[one.model].add(one.way)
    if ways and not set.intersection(*ways.values()):
        each = "; ".join(f"{name}: {', '.join(sorted(own)) or 'none'}" for name, own in ways.items())
        said = f"its models have no condition in common ({each}); play all of them in one"
        yield Mistake(place, said, absent=True)


# -- drift -------------------------------------------------------------------------------------------------------


def _drift(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    every = list(members(study))
    planned = {(one.model, one.way) for one in every}
    acted = {one.model for one in every if one.block.conditions}
    shown = {table.drift for table in study.tables.values()}
    for name, table in study.drift.items():
        place = ("drift", name, "pairs")
        for side in dict.fromkeys(one for pair in table.pairs for one in pair):
            model, _slash, way = side.partition("/")
            if model not in study.models:
                yield from each_unknown(place, "model", [model], list(study.models))
            elif way and (model, way) not in planned:
                yield Mistake(place, f"no block makes the run {side!r}", absent=True)
            elif not way and model not in acted:
                ways = [way for name, way in planned if name == model]
                said = (
                    "asked in several ways; name one"
                    if len(ways) > 1
                    else "not played in a condition; name its ask"
                )
                yield Mistake(place, f"{model!r} is {said}, as `{model}/{min(ways, default='ASK')}`", absent=True)
            elif name in shown:
                yield from _other_view(study, side_members(every, side), table.view, side, place[:2])
        for one, other in table.pairs:
            yield from _other_streams(study, one, other, place)


def side_members(every: list[Member], side: str) -> list[Member]:
    """The runs that a side of a pair of drift names: those of a model's first condition, or of the one given."""
    model, _, way = side.partition("/")
    own = [one for one in every if one.model == model and (one.way == way if way else one.block.conditions)]
    return [one for one in own if one.way == own[0].way]


def _other_view(study: Study, runs: list[Member], view: str, side: str, place: Place) -> Iterator[Mistake]:
    """Runs without activations, and a view that the file's probes lack. A file without probes may have others."""
    for block in {one.block.name: one.block for one in runs if one.block.asks and not _stores(one.block)}.values():
        said = f"{side!r} is asked by block {block.name!r} with tokens none, which leaves nothing to compare"
        yield Mistake((*place, "pairs"), said, absent=True)
    blocks = {one.block.name for one in runs}
    fitted = [table for table in study.probes.values() if table.target == "correct" and blocks & set(table.runs)]
    if fitted and not any(view in table.views for table in fitted):
        views = dict.fromkeys(one for table in fitted for one in table.views)
        said = f"the view {view!r} of {side!r} is not probed; its probes have {', '.join(views)}"
        yield Mistake((*place, "view"), said, absent=True)


def _other_streams(study: Study, one: str, other: str, place: Place) -> Iterator[Mistake]:
    """Pairs whose backbones cannot have a site of one name and width, as far as their families say it."""
    models = [study.models.get(side.partition("/")[0]) for side in (one, other)]
    streams = [[own.stream for own in _declared(model)] if model else [] for model in models]
    widths = [{(own.name, own.width) for own in each if own.part == "backbone"} for each in streams]
    if all(widths) and not widths[0] & widths[1]:
        each = " and ".join(", ".join(f"{name} of {width}" for name, width in sorted(own)) for own in widths)
        said = f"{one!r} and {other!r} have no backbone of one name and width in common ({each})"
        yield Mistake(place, f"{said}: probes of one cannot be used on the other")


# -- tables and figures ------------------------------------------------------------------------------------------


def _tables(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, table in study.tables.items():
        place = ("tables", name)
        yield from _unknown_blocks((*place, "runs"), table.runs, study)
        yield from category_mistakes((*place, "categories"), table.categories, suite)
        needed = _NEEDS.get(table.kind, "runs")
        if getattr(table, needed) is None:
            yield Mistake(place, f"a table of kind {table.kind!r} needs `{needed}`", absent=True)
        for part, known in (("comparison", study.comparisons), ("drift", study.drift)):
            named = getattr(table, part)
            if named is not None and part != needed:
                yield Mistake((*place, part), f"a table of kind {table.kind!r} shows no {part}; leave it out")
            elif named is not None:
                yield from each_unknown((*place, part), part, [named], list(known))
        yield from _kind_of_comparison(study, name)
        yield from _nothing_to_show(study, table, place)
        yield from _nothing_compared(study, table, place)
        yield from _not_shown(study, table.runs or [], table.categories, suite, place)
        yield from _elsewhere(study, table, place)


def _kind_of_comparison(study: Study, name: str) -> Iterator[Mistake]:
    table = study.tables[name]
    wanted, comparison = _SHOWS.get(table.kind), study.comparisons.get(table.comparison or "")
    if wanted and comparison is not None and getattr(comparison, wanted) is None:
        said = f"{table.comparison!r} has no {wanted}, which a table of kind {table.kind!r} shows"
        yield Mistake(("tables", name, "comparison"), said, absent=True)


def _nothing_to_show(study: Study, table: TableTable, place: Place) -> Iterator[Mistake]:
    """Tables whose blocks have no run of the kind that they are made of."""
    blocks = _blocks(study, table.runs or ())
    if len(blocks) < len(table.runs or [""]):
        return
    said = ""
    if table.kind == "vlms" and not any(block.asks for block in blocks):
        said = "has VLMs, and no block of `runs` asks one"
    elif table.kind in ("vlm-vla", "stages") and not _has_vlm(study, blocks):
        said = "has VLMs beside policies, and `runs` have no policy with its VLM: name it as `vlm` of the policy"
    if said:
        yield Mistake((*place, "runs"), f"a table of kind {table.kind!r} {said}", absent=True)


def _nothing_compared(study: Study, table: TableTable, place: Place) -> Iterator[Mistake]:
    """Tables of a comparison whose blocks have none of its models."""
    comparison = study.comparisons.get(table.comparison or "")
    if comparison is None or table.runs is None or len(_blocks(study, table.runs)) < len(table.runs):
        return
    groups = set(comparison.groups or ())
    models = {name for name, one in study.models.items() if groups & set(one.groups)} | set(comparison.chain or ())
    models |= set(comparison.pairs.models) if comparison.pairs else set()
    if not any(one.model in models for one in members(study) if one.block.name in table.runs):
        said = f"have no model of the comparison {table.comparison!r}; leave `runs` out, or name its blocks"
        yield Mistake((*place, "runs"), said, absent=True)


def _has_vlm(study: Study, blocks: list[BlockTable]) -> bool:
    asked = {name for block in blocks if block.asks for name in block.models}
    acting = {name for block in blocks if block.conditions for name in block.models if name in study.models}
    return any(study.models[name].vlm in asked for name in acting)


def _not_shown(
    study: Study, runs: list[str], categories: list[str] | None, suite: PlannedSuite, place: Place
) -> Iterator[Mistake]:
    """Categories of a table or figure that none of its blocks has."""
    blocks = _blocks(study, runs)
    played = {name for block in blocks for name in _chosen(study, block, suite)}
    for name in slugs(categories or ()) if len(blocks) == len(runs) and blocks else ():
        if name in suite.items and name not in played:
            said = f"{name!r} is in no block of `runs`, which have {', '.join(sorted(played))}"
            yield Mistake((*place, "categories"), said, absent=True)


def _elsewhere(study: Study, table: TableTable, place: Place) -> Iterator[Mistake]:
    if table.elsewhere is None:
        return
    place = (*place, "elsewhere")
    if table.kind != "score":
        said = f"numbers from elsewhere stand in tables of kind 'score', not {table.kind!r}"
        yield Mistake(place, said)
    yield from each_unknown(place, "model", table.elsewhere.values, list(study.models))
    shown = {name for block in _blocks(study, table.runs or ()) for name in block.models}
    for name in table.elsewhere.values:
        if name in study.models and shown and name not in shown:
            yield Mistake(place, f"{name!r} is in no block of `runs`, so its number has no row", absent=True)


def _figures(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, figure in study.figures.items():
        place, blocks = ("figures", name), _blocks(study, figure.runs)
        yield from _unknown_blocks((*place, "runs"), figure.runs, study)
        yield from category_mistakes((*place, "categories"), figure.categories, suite)
        yield from _not_shown(study, figure.runs, figure.categories, suite, place)
        if figure.view is not None and figure.kind != "curves":
            yield Mistake((*place, "view"), f"a figure of kind {figure.kind!r} has no views; leave it out")
        if figure.kind != "curves" or len(blocks) < len(figure.runs):
            continue
        own = [table for table in study.probes.values() if set(table.runs) & {block.name for block in blocks}]
        views = dict.fromkeys(view for table in own for view in table.views)
        if own and figure.view is not None and figure.view not in views:
            said = f"the view {figure.view!r} is not probed; the probes of `runs` have {', '.join(views)}"
            yield Mistake((*place, "view"), said, absent=True)
