"""Checks of a study file: unknown names, then tables that do not fit together where all names are known."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter

from probe_kit.errors import ProbeKitError
from probe_kit.extract.parts import SCRIPTED
from probe_kit.hooks.contract.declared import DeclaredStream, check_options
from probe_kit.hooks.contract.sites import resolve_view, view_names
from probe_kit.hooks.registry import family_names, find_family, get_family
from probe_kit.runs.store import SCHEMES
from probe_kit.statistics.label_permutations import permutations_for, smallest_p
from probe_kit.statistics.significance import SIGNIFICANCE
from probe_kit.study.cells import FOLDER, PlannedSuite, slug, slugs
from probe_kit.study.expansion import Member, acts, answers, categories_of, excludes, members, runs_of_side
from probe_kit.study.schema import (
    BlockTable,
    Mistake,
    ModelTable,
    Place,
    ProbesTable,
    Study,
    TableKind,
    TableTable,
    complaint_of_unknown,
)
from probe_kit.suite.categories import check_slug
from probe_kit.train.choices import CORRECT

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
        Mistake(path, complaint_of_unknown(kind, name, names[kind]))
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


FEWEST_ITEMS = 10
"""Number of items of a category that five folds need, where every group is a pair of counterparts."""
_NEEDS: Mapping[TableKind, str] = {
    "ablation": "comparison",
    "groups": "comparison",
    "chain": "comparison",
    "drift": "drift",
}
"""By kind of table, the field that names its content; other kinds need `runs`."""
_COMPARES = {"ablation": "pairs", "chain": "chain", "groups": "groups"}
"""By kind of table, the kind of comparison it shows."""
_OF_PROBES = ("probing", "as-paper", "curves")
"""Kinds of tables and figures that have nothing to show without probes of sides."""
_POOLED = ("mean", "last", "tokens")
_BY_ROLE = ("mean:", "tokens:")
"""The beginnings of views of one role."""


def misfits(study: Study, suite: PlannedSuite) -> list[Mistake]:
    """Return the mistakes of tables that do not fit together, in order. Every name of the file is known."""
    checks: tuple[Callable[[Study, PlannedSuite], Iterator[Mistake]], ...] = (
        _out, _suite, _models, _lineages, _run_blocks, _excludes, _unused_names, _probes, _comparisons, _drift,
        _tables, _figures,
    )  # fmt: skip
    return [mistake for check in checks for mistake in check(study, suite)]


def _blocks(study: Study, names: Iterable[str]) -> list[BlockTable]:
    return [block for block in study.runs if block.name in names]


def _out(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    scheme, is_url, _path = study.folder.partition("://")
    if is_url and scheme not in SCHEMES:
        yield Mistake(("out",), f"runs lie in folders or at {', '.join(f'{name}://' for name in SCHEMES)}")


def _suite(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    counts = list(study.suite.counts)
    if counts and study.suite.path is None:
        yield Mistake(("suite", "counts"), "belongs to a suite of your own; give its `path`, or leave it out")
    for position, name in enumerate(counts):
        path = ("suite", "counts", name)
        if slug(name) in slugs(counts[:position]):
            yield Mistake(path, f"{slug(name)} is counted twice; name each category once")
        try:
            check_slug(slug(name))
        except ProbeKitError as error:
            yield Mistake(path, str(error))
    yield from _items(("suite", "items"), study.suite.items, suite, study.suite.categories)


def _items(path: Place, items: int | None, suite: PlannedSuite, categories: list[str] | None) -> Iterator[Mistake]:
    few = [
        f"{name} has {suite.items[name]}"
        for name in slugs(categories or list(suite.items))
        if items is not None and suite.items.get(name, items) < items
    ]
    if few:
        yield Mistake(path, f"{items} items are asked for, and {', '.join(few)}")


# -- models ------------------------------------------------------------------------------------------------------


def _models(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    first: dict[str, str] = {}  # by label, by which tables tell models apart
    for name, model in study.models.items():
        path = ("models", name)
        label = model.label or name
        if (other := first.setdefault(label, name)) != name:
            text = f"{other!r} is called {label!r} too; give each model a label of its own"
            yield Mistake((*path, *(["label"] if model.label else [])), text)
        if name == FOLDER:
            yield Mistake(path, "is the name of the folder of failures; give the model another")
        if model.family not in SCRIPTED and not model.unavailable:
            try:
                check_options(model.family, find_family(model.family).options, model.options)
            except ProbeKitError as error:
                yield Mistake((*path, "options"), str(error))
        if model.weights_seed and not model.random_weights:
            yield Mistake((*path, "weights_seed"), "belongs to random weights; add random_weights = true")
        if model.vlm is not None and not answers(vlm := study.models[model.vlm]):
            text = f"{model.vlm!r} ({vlm.family}) does not answer questions; name a VLM"
            yield Mistake((*path, "vlm"), text)
        if model.untrained is not None:
            network = study.models[model.untrained]
            if network.family != model.family or not network.random_weights:
                text = f"{model.untrained!r} must be of family {model.family} with random_weights = true"
                yield Mistake((*path, "untrained"), text)


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
    for position, block in enumerate(study.runs):
        path = ("runs", position)
        if block.name in names[:position]:
            yield Mistake((*path, "name"), f"a block is already called {block.name!r}; give each its own name")
        for name in block.models:
            model = study.models[name]
            if block.conditions and not acts(model):
                yield Mistake((*path, "models"), f"{name!r} ({model.family}) does not act; ask it, with asks")
            if block.asks and not answers(model):
                text = f"{name!r} ({model.family}) answers no questions; play it, with conditions"
                yield Mistake((*path, "models"), text)
        yield from _items((*path, "items"), block.items, suite, block.categories or study.suite.categories)
        if block.conditions and block.tokens == "none":
            yield Mistake((*path, "tokens"), "a policy's run stores pooled or all tokens; none is for asks")


def _excludes(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    for position, block in enumerate(study.runs):
        # `strange` is the part of a rule that names nothing in a block of this kind.
        ways, strange = block.conditions or block.asks or [], "ask" if block.conditions else "condition"
        for rule in block.exclude:
            parts = rule.model_dump(exclude_none=True)
            matched = any(excludes(parts, model, way) for model in block.models for way in ways)
            if not parts or strange in parts or not matched:
                text = ", ".join(f"{part} {value!r}" for part, value in parts.items()) or "nothing named"
                yield Mistake(("runs", position, "exclude"), f"{text} excludes no run of block {block.name!r}")


def _unused_names(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    used = list(members(study))
    networks = (model.untrained for model in study.models.values())
    in_use: dict[str, set[str | None]] = {
        "models": {*(member.model for member in used), *networks},
        "conditions": {*(member.way for member in used if member.block.conditions)},
        "asks": {*(member.way for member in used if member.block.asks)},
    }
    for kind, names in in_use.items():
        for name in getattr(study, kind):
            if name not in names:
                yield Mistake((kind, name), "is in no run; use it in a block, or remove it")


# -- probes ------------------------------------------------------------------------------------------------------


def _probes(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    probed: dict[tuple[str, str], str] = {}
    for name, table in study.probes.items():
        path = ("probes", name)
        for block in _blocks(study, table.runs):
            if (other := probed.setdefault((block.name, table.target), name)) != name:
                text = f"block {block.name!r} is probed by {other!r} too, and tables show one of both"
                yield Mistake((*path, "runs"), f"{text}; give one of them all views")
            if block.asks and not _stores(block):
                text = f"block {block.name!r} asks with tokens none, which leaves nothing to probe"
                yield Mistake((*path, "runs"), text)
            yield from _few_items(study, block, suite, (*path, "runs"))
            for model in block.models:
                yield from _views((*path, "views"), table.views, study.models[model])
        if table.permutations and smallest_p(table.permutations) > SIGNIFICANCE:  # tables say what equality leaves
            text = f"{table.permutations} are too few: no p can be below {SIGNIFICANCE}"
            yield Mistake((*path, "permutations"), f"{text}. Give at least {permutations_for()}")
        if "untrained" in table.controls:
            yield from _without_control(study, table, (*path, "controls"))


def _stores(block: BlockTable) -> bool:
    return (block.tokens or "none") != "none"


def _few_items(study: Study, block: BlockTable, suite: PlannedSuite, path: Place) -> Iterator[Mistake]:
    items = block.items or study.suite.items
    few = [
        name
        for name in categories_of(study, block, suite)
        if name in suite.items and min(items or suite.items[name], suite.items[name]) < FEWEST_ITEMS
    ]
    if few:
        text = f"block {block.name!r} has fewer than {FEWEST_ITEMS} items of {', '.join(few)}"
        yield Mistake(path, f"{text}, which are too few groups for five folds")


def _views(path: Place, views: list[str], model: ModelTable) -> Iterator[Mistake]:
    """Yield a mistake for views that no stream of a model has, or of unknown form where streams are unknown."""
    declared = [view for stream in _declared_streams(model) for view in view_names(stream.roles)]
    for view in views:
        pooled = view.replace("tokens", "mean", 1)  # every token is there of what has a mean
        has_form = view in _POOLED or (view.startswith(_BY_ROLE) and view.partition(":")[2])
        if not has_form or (declared and resolve_view(pooled, declared) not in declared):
            names = ", ".join(dict.fromkeys(declared)) or "mean, last, or mean:ROLE such as mean:language"
            text = f"{view!r} is no view of {model.family}; expected some of {names}; tokens for every token"
            yield Mistake(path, text)


def _declared_streams(model: ModelTable) -> tuple[DeclaredStream, ...]:
    """Return the streams that a family declares; none where it declares none, or the options are wrong."""
    family = get_family(model.family)
    try:
        return (family and family.declared_streams(model.options)) or ()
    except ProbeKitError:
        return ()


def _without_control(study: Study, table: ProbesTable, path: Place) -> Iterator[Mistake]:
    played = {member.model for member in members(study)}
    for name in (name for block in _blocks(study, table.runs) for name in block.models):
        model = study.models[name]
        if model.unavailable or model.random_weights:
            continue
        if model.untrained is None:
            yield Mistake(path, f"{name!r} names no untrained network; add `untrained` to it")
        elif model.untrained not in played:
            yield Mistake(path, f"{model.untrained!r}, the control of {name!r}, is in no run")


# -- comparisons -------------------------------------------------------------------------------------------------


def _comparisons(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    planned = {(member.model, member.way) for member in members(study)}
    for name, table in study.comparisons.items():
        path = ("comparisons", name)
        if sum(part is not None for part in (table.pairs, table.chain, table.groups)) != 1:
            yield Mistake(path, "give exactly one of pairs, chain and groups")
        if table.pairs is not None:
            for model in table.pairs.models:
                for way in table.pairs.conditions:
                    if (model, way) not in planned:
                        yield Mistake((*path, "pairs"), f"no block plays {model!r} in {way!r}")
        yield from _without_common_condition(study, table.chain or [], (*path, "chain"))
        yield from _check_groups(study, table.groups or [], (*path, "groups"))


def _check_groups(study: Study, names: list[str], path: Place) -> Iterator[Mistake]:
    """Yield a mistake for models in several groups of a comparison, and groups without a common condition."""
    groups = {name: [group for group in model.groups if group in names] for name, model in study.models.items()}
    for name, of_model in groups.items():
        if len(of_model) > 1:
            text = f"{name!r} is in {' and '.join(map(repr, of_model))}; groups have no model in common"
            yield Mistake(path, text)
    yield from _without_common_condition(study, [name for name, of_model in groups.items() if of_model], path)


def _without_common_condition(study: Study, models: list[str], path: Place) -> Iterator[Mistake]:
    """Yield a mistake for models that are to be compared and are not played in one condition."""
    ways: dict[str, set[str]] = {name: set() for name in models}
    for member in members(study):
        if member.model in ways and member.block.conditions:
            ways[member.model].add(member.way)
    if ways and not set.intersection(*ways.values()):
        each = "; ".join(f"{name}: {', '.join(sorted(of_model)) or 'none'}" for name, of_model in ways.items())
        yield Mistake(path, f"its models have no condition in common ({each}); play all of them in one")


# -- drift -------------------------------------------------------------------------------------------------------


def _drift(study: Study, _: PlannedSuite) -> Iterator[Mistake]:
    every = list(members(study))
    printed = {table.drift for table in study.tables.values()}
    for name, table in study.drift.items():
        path = ("drift", name)
        for side in dict.fromkeys(side for pair in table.pairs for side in pair):
            model, _slash, way = side.partition("/")
            runs = runs_of_side(every, side)
            if way and not runs:
                yield Mistake((*path, "pairs"), f"no block makes the run {side!r}")
            elif not runs:
                ways = [member.way for member in every if member.model == model]
                several = "asked in several ways; name one"
                text = several if len(ways) > 1 else "not played in a condition; name its ask"
                text = f"{model!r} is {text}, as `{model}/{min(ways, default='ASK')}`"
                yield Mistake((*path, "pairs"), text)
            elif name in printed:
                yield from _other_view(study, runs, table.view, side, path)
        for side, second in table.pairs:
            yield from _other_streams(study, side, second, (*path, "pairs"))


def _other_view(study: Study, runs: list[Member], view: str, side: str, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for runs without activations, and for a view that the file's probes of them lack."""
    blocks = {member.block.name: member.block for member in runs}
    for block in blocks.values():
        if block.asks and not _stores(block):
            text = f"{side!r} is asked by block {block.name!r} with tokens none, which leaves nothing to compare"
            yield Mistake((*path, "pairs"), text)
    views = _probed_views(study, blocks)
    if views and view not in views:
        text = f"the view {view!r} of {side!r} is not probed; its probes have {', '.join(views)}"
        yield Mistake((*path, "view"), text)


def _other_streams(study: Study, side: str, second: str, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for backbones without a site of one name and width, as far as their families declare it."""
    widths = [
        {
            (declared.stream.name, declared.stream.width)
            for declared in _declared_streams(study.models[name.partition("/")[0]])
            if declared.stream.part == "backbone"
        }
        for name in (side, second)
    ]
    if all(widths) and not widths[0] & widths[1]:
        each = " and ".join(", ".join(f"{name} of {width}" for name, width in sorted(pairs)) for pairs in widths)
        text = f"{side!r} and {second!r} have no backbone of one name and width in common ({each})"
        yield Mistake(path, f"{text}: probes of one cannot be used on the other")


# -- tables and figures ------------------------------------------------------------------------------------------


def _tables(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, table in study.tables.items():
        path, needed = ("tables", name), _NEEDS.get(table.kind, "runs")
        if getattr(table, needed) is None:
            yield Mistake(path, f"a table of kind {table.kind!r} needs `{needed}`")
        for part in ("comparison", "drift"):
            if getattr(table, part) is not None and part != needed:
                yield Mistake((*path, part), f"a table of kind {table.kind!r} shows no {part}; leave it out")
        yield from _other_comparison(study, table, path)
        yield from _nothing_to_print(study, table, (*path, "runs"))
        if table.kind in _OF_PROBES:
            yield from _check_probes(study, table.runs or [], f"a table of kind {table.kind!r}", (*path, "runs"))
        yield from _absent_categories(study, table.runs or [], table.categories, suite, path)
        if table.elsewhere is None:
            continue
        if table.kind != "score":
            text = f"numbers from elsewhere stand in tables of kind 'score', not {table.kind!r}"
            yield Mistake((*path, "elsewhere"), text)
        printed = {model for block in _blocks(study, table.runs or ()) for model in block.models}
        for model in table.elsewhere.values:
            if printed and model not in printed:
                text = f"{model!r} is in no block of `runs`, so its number has no row"
                yield Mistake((*path, "elsewhere"), text)


def _other_comparison(study: Study, table: TableTable, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for a comparison of another kind, or of models that the table's blocks lack."""
    comparison, part = study.comparisons.get(table.comparison or ""), _COMPARES.get(table.kind)
    if comparison is None:
        return
    if part and getattr(comparison, part) is None:
        text = f"{table.comparison!r} has no {part}, which a table of kind {table.kind!r} shows"
        yield Mistake((*path, "comparison"), text)
    groups = set(comparison.groups or ())
    models = {name for name, model in study.models.items() if groups & set(model.groups)}
    models |= {*(comparison.chain or ()), *(comparison.pairs.models if comparison.pairs else ())}
    runs = table.runs
    if runs is not None and not any(each.model in models for each in members(study) if each.block.name in runs):
        text = f"have no model of the comparison {table.comparison!r}; leave `runs` out, or name its blocks"
        yield Mistake((*path, "runs"), text)


def _nothing_to_print(study: Study, table: TableTable, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for a table whose blocks have no run of the kind that it is made of."""
    if table.runs is None:
        return
    blocks, text = _blocks(study, table.runs), ""
    vlms = {name for block in blocks if block.asks for name in block.models}
    policies = {name for block in blocks if block.conditions for name in block.models}
    if table.kind == "vlms" and not vlms:
        text = "has VLMs, and no block of `runs` asks one"
    elif table.kind in ("vlm-vla", "stages") and not any(study.models[name].vlm in vlms for name in policies):
        text = "has VLMs beside policies, and `runs` have no policy with its VLM: name it as `vlm` of the policy"
    if text:
        yield Mistake(path, f"a table of kind {table.kind!r} {text}")


def _check_probes(study: Study, runs: list[str], subject: str, path: Place) -> Iterator[Mistake]:
    """Yield a mistake for blocks whose probes are to be shown, and no run of which a table of probes names."""
    probed = {name for table in study.shown_probes.values() for name in table.runs}
    # Blocks share runs, so that a block without probes of its own can show those of another one.
    of_runs, of_probes = (
        {member.run for member in members(study) if member.block.name in blocks} for blocks in (runs, probed)
    )
    if of_runs and not of_runs & of_probes:
        text = f"{subject} shows probes of {CORRECT}; name a block of `runs` in a table [probes.NAME]"
        yield Mistake(path, text)


def _probed_views(study: Study, blocks: Collection[str]) -> list[str]:
    """Return the views of the probes that drift and figures of some blocks show, in the order of the file."""
    tables = (table for table in study.shown_probes.values() if set(blocks) & set(table.runs))
    return list(dict.fromkeys(view for table in tables for view in table.views))


def _absent_categories(
    study: Study, runs: list[str], categories: list[str] | None, suite: PlannedSuite, path: Place
) -> Iterator[Mistake]:
    """Yield a mistake for categories of a table or figure that none of its blocks has."""
    played = {name for block in _blocks(study, runs) for name in categories_of(study, block, suite)}
    for name in slugs(categories or ()) if played else ():
        if name not in played:
            text = f"{name!r} is in no block of `runs`, which have {', '.join(sorted(played))}"
            yield Mistake((*path, "categories"), text)


def _figures(study: Study, suite: PlannedSuite) -> Iterator[Mistake]:
    for name, figure in study.figures.items():
        path = ("figures", name)
        yield from _absent_categories(study, figure.runs, figure.categories, suite, path)
        if figure.kind in _OF_PROBES:
            yield from _check_probes(study, figure.runs, f"a figure of kind {figure.kind!r}", (*path, "runs"))
        if figure.view is None:
            continue
        if figure.kind != "curves":
            yield Mistake((*path, "view"), f"a figure of kind {figure.kind!r} has no views; leave it out")
            continue
        views = _probed_views(study, figure.runs)
        if views and figure.view not in views:
            text = f"the view {figure.view!r} is not probed; the probes of `runs` have {', '.join(views)}"
            yield Mistake((*path, "view"), text)
