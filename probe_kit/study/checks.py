"""Checks of a study file that its schema cannot make: names of other tables, and what does not fit together."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter

from probe_kit.errors import ProbeKitError
from probe_kit.hooks.contract.declared import DeclaredStream
from probe_kit.hooks.contract.options import check_options
from probe_kit.hooks.contract.sites import Stream
from probe_kit.hooks.contract.views import resolve_view, view_names
from probe_kit.hooks.registry import family_names, find_family, get_family
from probe_kit.runs.store import SCHEMES
from probe_kit.statistics.label_permutations import permutations_for, shortage, smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study.expansion import SCRIPTED, Member, acts, answers, excludes, is_known, members
from probe_kit.study.failures import FOLDER
from probe_kit.study.mistakes import Mistake, Place, each_unknown
from probe_kit.study.planned_suite import PlannedSuite, slug, slugs
from probe_kit.study.schema import BlockTable, ModelTable, ProbesTable, Study, TableKind, TableTable
from probe_kit.suite.categories import check_slug
from probe_kit.train.choices import CORRECT

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


def reference_mistakes(study: Study, suite: PlannedSuite) -> list[Mistake]:
    """Return everything that is wrong with the names of a file, in the order of its tables."""
    checks: tuple[Callable[[Study, PlannedSuite], Iterator[Mistake]], ...] = (
        _out, _suite, _models, _labels, _lineages, _run_blocks, _excludes, _unused, _probes, _comparisons, _drift,
        _tables, _figures,
    )  # fmt: skip
    return [mistake for check in checks for mistake in check(study, suite)]


def _category_mistakes(path: Place, names: list[str] | None, suite: PlannedSuite) -> Iterator[Mistake]:
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


def _out(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    scheme, is_url, _rest = study.folder.partition("://")
    if is_url and scheme not in SCHEMES:
        yield Mistake(("out",), f"runs lie in folders or at {', '.join(f'{name}://' for name in SCHEMES)}")


def _suite(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    counts = list(study.suite.counts)
    if counts and study.suite.path is None:
        yield Mistake(("suite", "counts"), "belongs to a suite of your own; give its `path`, or leave it out")
    for at, name in enumerate(counts):
        path = ("suite", "counts", name)
        if slug(name) in slugs(counts[:at]):
            yield Mistake(path, f"{slug(name)} is counted twice; name each category once")
        try:
            check_slug(slug(name))
        except ProbeKitError as error:
            yield Mistake(path, str(error))
    yield from _category_mistakes(("suite", "categories"), study.suite.categories, suite)
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
        path = ("models", name)
        if name == FOLDER:
            yield Mistake(path, "is the name of the folder of failures; give the model another")
        if not is_known(model):
            yield from each_unknown((*path, "family"), "family", [model.family], [*families, *SCRIPTED])
            continue
        if model.family in families and not model.unavailable:
            yield from _option_mistakes(name, model)
        if model.weights_seed and not model.random_weights:
            yield Mistake((*path, "weights_seed"), "belongs to random weights; add random_weights = true")
        for part in ("vlm", "finetuned_from", "untrained"):
            target = getattr(model, part)
            if target is not None and target not in study.models:
                yield from each_unknown((*path, part), "model", [target], list(study.models))
            elif target is not None:
                yield from _relation(study, name, part, target)


def _labels(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    """Tables tell systems apart by their labels."""
    of: dict[str, str] = {}
    for name, model in study.models.items():
        label = model.label or name
        if (other := of.setdefault(label, name)) != name:
            path = ("models", name, *(["label"] if model.label else []))
            yield Mistake(path, f"{other!r} is called {label!r} too; give each model a label of its own")


def _option_mistakes(name: str, model: ModelTable) -> Iterator[Mistake]:
    try:
        check_options(model.family, find_family(model.family).options, model.options)
    except ProbeKitError as error:
        yield Mistake(("models", name, "options"), str(error))


def _relation(study: Study, name: str, part: str, target: str) -> Iterator[Mistake]:
    model, other, path = study.models[name], study.models[target], ("models", name, part)
    if part == "vlm" and is_known(other) and not answers(other):
        yield Mistake(path, f"{target!r} ({other.family}) does not answer questions; name a VLM")
    if part == "untrained" and (other.family != model.family or not other.random_weights):
        text = f"{target!r} must be of family {model.family} with random_weights = true"
        yield Mistake(path, text)


def _lineages(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for part in ("vlm", "finetuned_from", "untrained"):
        graph = {name: {target} for name, model in study.models.items() if (target := getattr(model, part))}
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            circle = error.args[1]
            yield Mistake(("models", circle[0], part), f"runs in a circle: {' → '.join(circle)}")


# -- blocks ------------------------------------------------------------------------------------------------------


def _run_blocks(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    names = [block.name for block in study.runs]
    for at, block in enumerate(study.runs):
        path = ("runs", at)
        if block.name in names[:at]:
            yield Mistake((*path, "name"), f"a block is already called {block.name!r}; give each its own name")
        if (block.conditions is None) == (block.asks is None):
            yield Mistake(path, "give either conditions, for policies, or asks, for VLMs")
        yield from each_unknown((*path, "models"), "model", block.models, list(study.models))
        for part, tables in (("conditions", study.conditions), ("asks", study.asks)):
            yield from each_unknown((*path, part), part[:-1], getattr(block, part) or (), list(tables))
        yield from _kinds(study, block, path)
        yield from _category_mistakes((*path, "categories"), block.categories, suite)
        yield from _items((*path, "items"), block.items, suite, block.categories or study.suite.categories)
        if block.conditions and block.tokens == "none":
            yield Mistake((*path, "tokens"), "a policy's run stores pooled or all tokens; none is for asks")


def _kinds(study: Study, block: BlockTable, path: Place) -> Iterator[Mistake]:
    for name in block.models:
        model = study.models.get(name)
        if model is None or not is_known(model):
            continue
        if block.conditions and not acts(model):
            yield Mistake((*path, "models"), f"{name!r} ({model.family}) does not act; ask it, with asks")
        if block.asks and not answers(model):
            text = f"{name!r} ({model.family}) answers no questions; play it, with conditions"
            yield Mistake((*path, "models"), text)


def _excludes(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for at, block in enumerate(study.runs):
        ways = block.conditions or block.asks or []
        for rule in block.exclude:
            named_parts = rule.model_dump(exclude_none=True)
            strange = "ask" if block.conditions else "condition"
            matched = any(excludes(named_parts, model, way) for model in block.models for way in ways)
            if not named_parts or strange in named_parts or not matched:
                text = ", ".join(f"{part} {value!r}" for part, value in named_parts.items()) or "nothing named"
                text = f"{text} excludes no run of block {block.name!r}"
                yield Mistake(("runs", at, "exclude"), text)


def _unused(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    used = list(members(study))
    twins = {model.untrained for model in study.models.values()}
    for home, names, in_use in (
        ("models", study.models, {member.model for member in used} | twins),
        ("conditions", study.conditions, {member.way for member in used if member.block.conditions}),
        ("asks", study.asks, {member.way for member in used if member.block.asks}),
    ):
        for name in names:
            if name not in in_use:
                yield Mistake((home, name), "is in no run; use it in a block, or remove it")


# -- probes ------------------------------------------------------------------------------------------------------


def _probes(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    before: dict[tuple[str, str], str] = {}
    for name, table in study.probes.items():
        path = ("probes", name)
        yield from _unknown_blocks((*path, "runs"), table.runs, study)
        for block in _blocks(study, table.runs):
            if (other := before.setdefault((block.name, table.target), name)) != name:
                text = f"block {block.name!r} is probed by {other!r} too, and tables show one of both"
                yield Mistake((*path, "runs"), f"{text}; give one of them all views")
            if block.asks and not _stores(block):
                text = f"block {block.name!r} asks with tokens none, which leaves nothing to probe"
                yield Mistake((*path, "runs"), text)
            yield from _enough_items(study, block, suite, (*path, "runs"))
            yield from _enough_permutations(table, path)
            for model in (study.models[model_name] for model_name in block.models if model_name in study.models):
                yield from _views((*path, "views"), table.views, model)
        if "untrained" in table.controls:
            yield from _without_control(study, table, path)


def _stores(block: BlockTable) -> bool:
    """Whether a block of asks stores activations."""
    return (block.tokens or "none") != "none"


def _enough_items(study: Study, block: BlockTable, suite: PlannedSuite, path: Place) -> Iterator[Mistake]:
    items = block.items or study.suite.items
    few = [
        name
        for name in _chosen(study, block, suite)
        if name in suite.items and min(items or suite.items[name], suite.items[name]) < FEWEST_ITEMS
    ]
    if few:
        text = f"block {block.name!r} has fewer than {FEWEST_ITEMS} items of {', '.join(few)}"
        yield Mistake(path, f"{text}, which are too few groups for five folds")


def _enough_permutations(table: ProbesTable, path: Place) -> Iterator[Mistake]:
    if table.permutations and shortage(smallest_p(table.permutations), table.permutations):
        text = f"{table.permutations} are too few: no p can be below {SIGNIFICANCE}. Give at least"
        yield Mistake((*path, "permutations"), f"{text} {permutations_for()}")


def _views(path: Place, views: list[str], model: ModelTable) -> Iterator[Mistake]:
    """Views that no stream of a model has, or of which that is not known, that cannot be the name of one."""
    streams = _declared(model)
    declared = [view for stream in streams for view in view_names(stream.roles)]
    for view in views:
        pooled = view.replace("tokens", "mean", 1)
        has_form = view in _POOLED or (view.startswith(_BY_ROLE) and view.partition(":")[2])
        if not has_form or (declared and resolve_view(pooled, declared) not in declared):
            names = ", ".join(dict.fromkeys(declared)) or "mean, last, or mean:ROLE such as mean:language"
            text = f"{view!r} is no view of {model.family}; expected some of {names}; tokens for every token"
            yield Mistake(path, text)


def _declared(model: ModelTable) -> tuple[DeclaredStream, ...]:
    """The streams that a family declares; none where it declares none, or the options are wrong."""
    family = get_family(model.family)
    try:
        return (family and family.declared_streams(model.options)) or ()
    except ProbeKitError:
        return ()


def _without_control(study: Study, table: ProbesTable, path: Place) -> Iterator[Mistake]:
    played = {member.model for member in members(study)}
    for block in _blocks(study, table.runs):
        for name in block.models:
            model = study.models.get(name)
            if model is None or model.unavailable or model.random_weights:
                continue
            text = ""
            if model.untrained is None:
                text = f"{name!r} names no untrained network; add `untrained` to it"
            elif model.untrained not in played:
                text = f"{model.untrained!r}, the control of {name!r}, is in no run"
            if text:
                yield Mistake((*path, "controls"), text)


# -- comparisons -------------------------------------------------------------------------------------------------


def _comparisons(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    groups = list(dict.fromkeys(group for model in study.models.values() for group in model.groups))
    for name, table in study.comparisons.items():
        path = ("comparisons", name)
        if sum(part is not None for part in (table.pairs, table.chain, table.groups)) != 1:
            yield Mistake(path, "give exactly one of pairs, chain and groups")
        if table.pairs is not None:
            ways = [*study.conditions, *study.asks]
            yield from each_unknown((*path, "pairs"), "condition or ask", table.pairs.conditions, ways)
            yield from each_unknown((*path, "pairs"), "model", table.pairs.models, list(study.models))
            yield from _missing_pairs(study, table.pairs.models, table.pairs.conditions, (*path, "pairs"))
        yield from each_unknown((*path, "chain"), "model", table.chain or (), list(study.models))
        yield from _without_common_condition(study, table.chain or [], (*path, "chain"))
        yield from each_unknown((*path, "groups"), "group", table.groups or (), groups)
        yield from _grouped(study, table.groups or [], (*path, "groups"))


def _missing_pairs(study: Study, models: list[str], ways: list[str], path: Place) -> Iterator[Mistake]:
    planned = {(member.model, member.way) for member in members(study)}
    names = [*study.conditions, *study.asks]
    for model in models:
        for way in ways:
            if model in study.models and way in names and (model, way) not in planned:
                yield Mistake(path, f"no block plays {model!r} in {way!r}")


def _grouped(study: Study, names: list[str], path: Place) -> Iterator[Mistake]:
    """Models that are in several groups of a comparison, and groups without a condition that all have."""
    of = {name: [group for group in model.groups if group in names] for name, model in study.models.items()}
    for name, of_model in of.items():
        if len(of_model) > 1:
            yield Mistake(
                path, f"{name!r} is in {' and '.join(map(repr, of_model))}; groups have no model in common"
            )
    yield from _without_common_condition(study, [name for name, of_model in of.items() if of_model], path)


def _without_common_condition(study: Study, models: list[str], path: Place) -> Iterator[Mistake]:
    """Models that were to be compared and are not played in one condition."""
    ways: dict[str, set[str]] = {name: set() for name in models if name in study.models}
    for member in members(study):
        if member.model in ways and member.block.conditions:
            ways[member.model].add(member.way)
    if ways and not set.intersection(*ways.values()):
        each = "; ".join(f"{name}: {', '.join(sorted(conditions)) or 'none'}" for name, conditions in ways.items())
        text = f"its models have no condition in common ({each}); play all of them in one"
        yield Mistake(path, text)


# -- drift -------------------------------------------------------------------------------------------------------


def _drift(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    every = list(members(study))
    planned = {(member.model, member.way) for member in every}
    acted = {member.model for member in every if member.block.conditions}
    printed = {table.drift for table in study.tables.values()}
    for name, table in study.drift.items():
        path = ("drift", name, "pairs")
        for side in dict.fromkeys(member for pair in table.pairs for member in pair):
            model, _slash, way = side.partition("/")
            if model not in study.models:
                yield from each_unknown(path, "model", [model], list(study.models))
            elif way and (model, way) not in planned:
                yield Mistake(path, f"no block makes the run {side!r}")
            elif not way and model not in acted:
                ways = [way for name, way in planned if name == model]
                text = (
                    "asked in several ways; name one"
                    if len(ways) > 1
                    else "not played in a condition; name its ask"
                )
                yield Mistake(path, f"{model!r} is {text}, as `{model}/{min(ways, default='ASK')}`")
            elif name in printed:
                yield from _other_view(study, _side_members(every, side), table.view, side, path[:2])
        for member, other in table.pairs:
            yield from _other_streams(study, member, other, path)


def _side_members(every: list[Member], side: str) -> list[Member]:
    """The runs that a side of a pair of drift names: those of a model's first condition, or of the named one."""
    model, _, way = side.partition("/")
    of_model = [
        member
        for member in every
        if member.model == model and (member.way == way if way else member.block.conditions)
    ]
    return [member for member in of_model if member.way == of_model[0].way]


def _other_view(study: Study, runs: list[Member], view: str, side: str, path: Place) -> Iterator[Mistake]:
    """Runs without activations, and a view that the file's probes lack. A file without probes may have others."""
    for block in {
        member.block.name: member.block for member in runs if member.block.asks and not _stores(member.block)
    }.values():
        text = f"{side!r} is asked by block {block.name!r} with tokens none, which leaves nothing to compare"
        yield Mistake((*path, "pairs"), text)
    blocks = {member.block.name for member in runs}
    fitted = [table for table in study.probes.values() if table.target == CORRECT and blocks & set(table.runs)]
    if fitted and not any(view in table.views for table in fitted):
        views = dict.fromkeys(member for table in fitted for member in table.views)
        text = f"the view {view!r} of {side!r} is not probed; its probes have {', '.join(views)}"
        yield Mistake((*path, "view"), text)


def _other_streams(study: Study, side: str, second: str, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for backbones without a site of one name and width, as far as their families say it."""
    models = [study.models.get(name.partition("/")[0]) for name in (side, second)]
    widths = [
        {(stream.name, stream.width) for stream in _backbones(model)} if model else set() for model in models
    ]
    if all(widths) and not widths[0] & widths[1]:
        each = " and ".join(", ".join(f"{name} of {width}" for name, width in sorted(pairs)) for pairs in widths)
        text = f"{side!r} and {second!r} have no backbone of one name and width in common ({each})"
        yield Mistake(path, f"{text}: probes of one cannot be used on the other")


def _backbones(model: ModelTable) -> Iterator[Stream]:
    return (declared.stream for declared in _declared(model) if declared.stream.part == "backbone")


# -- tables and figures ------------------------------------------------------------------------------------------


def _tables(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, table in study.tables.items():
        path = ("tables", name)
        yield from _unknown_blocks((*path, "runs"), table.runs, study)
        yield from _category_mistakes((*path, "categories"), table.categories, suite)
        needed = _NEEDS.get(table.kind, "runs")
        if getattr(table, needed) is None:
            yield Mistake(path, f"a table of kind {table.kind!r} needs `{needed}`")
        for part, tables in (("comparison", study.comparisons), ("drift", study.drift)):
            name_of_part = getattr(table, part)
            if name_of_part is not None and part != needed:
                yield Mistake((*path, part), f"a table of kind {table.kind!r} shows no {part}; leave it out")
            elif name_of_part is not None:
                yield from each_unknown((*path, part), part, [name_of_part], list(tables))
        yield from _kind_of_comparison(study, name)
        yield from _nothing_to_show(study, table, path)
        yield from _nothing_compared(study, table, path)
        yield from _not_shown(study, table.runs or [], table.categories, suite, path)
        yield from _elsewhere(study, table, path)


def _kind_of_comparison(study: Study, name: str) -> Iterator[Mistake]:
    table = study.tables[name]
    part, comparison = _SHOWS.get(table.kind), study.comparisons.get(table.comparison or "")
    if part and comparison is not None and getattr(comparison, part) is None:
        text = f"{table.comparison!r} has no {part}, which a table of kind {table.kind!r} shows"
        yield Mistake(("tables", name, "comparison"), text)


def _nothing_to_show(study: Study, table: TableTable, path: Place) -> Iterator[Mistake]:
    """Tables whose blocks have no run of the kind that they are made of."""
    blocks = _blocks(study, table.runs or ())
    if len(blocks) < len(table.runs or [""]):
        return
    text = ""
    if table.kind == "vlms" and not any(block.asks for block in blocks):
        text = "has VLMs, and no block of `runs` asks one"
    elif table.kind in ("vlm-vla", "stages") and not _has_vlm(study, blocks):
        text = "has VLMs beside policies, and `runs` have no policy with its VLM: name it as `vlm` of the policy"
    if text:
        yield Mistake((*path, "runs"), f"a table of kind {table.kind!r} {text}")


def _nothing_compared(study: Study, table: TableTable, path: Place) -> Iterator[Mistake]:
    """Tables of a comparison whose blocks have none of its models."""
    comparison = study.comparisons.get(table.comparison or "")
    if comparison is None or table.runs is None or len(_blocks(study, table.runs)) < len(table.runs):
        return
    groups = set(comparison.groups or ())
    models = {name for name, member in study.models.items() if groups & set(member.groups)} | set(
        comparison.chain or ()
    )
    models |= set(comparison.pairs.models) if comparison.pairs else set()
    if not any(member.model in models for member in members(study) if member.block.name in table.runs):
        text = f"have no model of the comparison {table.comparison!r}; leave `runs` out, or name its blocks"
        yield Mistake((*path, "runs"), text)


def _has_vlm(study: Study, blocks: list[BlockTable]) -> bool:
    vlms = {name for block in blocks if block.asks for name in block.models}
    acting = {name for block in blocks if block.conditions for name in block.models if name in study.models}
    return any(study.models[name].vlm in vlms for name in acting)


def _not_shown(
    study: Study, runs: list[str], categories: list[str] | None, suite: PlannedSuite, path: Place
) -> Iterator[Mistake]:
    """Categories of a table or figure that none of its blocks has."""
    blocks = _blocks(study, runs)
    played = {name for block in blocks for name in _chosen(study, block, suite)}
    for name in slugs(categories or ()) if len(blocks) == len(runs) and blocks else ():
        if name in suite.items and name not in played:
            text = f"{name!r} is in no block of `runs`, which have {', '.join(sorted(played))}"
            yield Mistake((*path, "categories"), text)


def _elsewhere(study: Study, table: TableTable, path: Place) -> Iterator[Mistake]:
    if table.elsewhere is None:
        return
    path = (*path, "elsewhere")
    if table.kind != "score":
        text = f"numbers from elsewhere stand in tables of kind 'score', not {table.kind!r}"
        yield Mistake(path, text)
    yield from each_unknown(path, "model", table.elsewhere.values, list(study.models))
    printed = {name for block in _blocks(study, table.runs or ()) for name in block.models}
    for name in table.elsewhere.values:
        if name in study.models and printed and name not in printed:
            yield Mistake(path, f"{name!r} is in no block of `runs`, so its number has no row")


def _figures(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, figure in study.figures.items():
        path, blocks = ("figures", name), _blocks(study, figure.runs)
        yield from _unknown_blocks((*path, "runs"), figure.runs, study)
        yield from _category_mistakes((*path, "categories"), figure.categories, suite)
        yield from _not_shown(study, figure.runs, figure.categories, suite, path)
        if figure.view is not None and figure.kind != "curves":
            yield Mistake((*path, "view"), f"a figure of kind {figure.kind!r} has no views; leave it out")
        if figure.kind != "curves" or len(blocks) < len(figure.runs):
            continue
        of_blocks = [
            table for table in study.probes.values() if set(table.runs) & {block.name for block in blocks}
        ]
        views = dict.fromkeys(view for table in of_blocks for view in table.views)
        if of_blocks and figure.view is not None and figure.view not in views:
            text = f"the view {figure.view!r} is not probed; the probes of `runs` have {', '.join(views)}"
            yield Mistake((*path, "view"), text)
