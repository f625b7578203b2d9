"""The command `probe-kit train`, and how `probe-kit run show` lists what it stored."""

import shlex
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.text import Text

from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._system.table_cells import is_count
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, markup, out, progress, say, split
from probe_kit.errors import TooFewGroupsError, UnbalancedEpisodesError, UsageError
from probe_kit.train import command_options as own
from probe_kit.train.choices import CORRECT

if TYPE_CHECKING:
    from rich.table import Table

    from probe_kit.runs import Run
    from probe_kit.train import ProbeResults, RunReader, Target
    from probe_kit.train.results.inventory import Inventory, StoredProbes


def train(
    run: common.RunFolder,
    categories: own.Categories = None,
    views: own.Views = own.MEAN,
    target: own.ProbeTarget = CORRECT,
    labels: own.LabelFile = None,
    task: own.LabelTask = None,
    group_by: own.GroupBy = None,
    exchange_within: own.ExchangeWithin = None,
    window: own.Window = None,
    align_to: own.AlignTo = None,
    test_on: own.TestOn = None,
    test_labels: own.TestLabels = None,
    across_weights: own.AcrossWeights = False,
    wording: common.Wording = None,
    call: own.Calls = "0",
    seed: common.Seed = 0,
    partial: common.Partial = False,
    controls: own.Controls = None,
    untrained: own.Untrained = None,
    suite: own.Suite = None,
    permutations: own.Permutations = 200,
    token_permutations: own.TokenPermutations = 59,
    folds: own.Folds = "groups",
    incomplete: own.IncompleteItems = "keep",
    jobs: own.Jobs = None,
    device: own.SolverDevice = None,
    ray: common.RayAddress = None,
    details: common.WholeTable = False,
    directions: own.DirectionFile = None,
) -> None:
    """Fit linear probes at every site and store their scores in the run.

    Cross-validation is nested and grouped; p-values come from permuted labels. Stored results of the same settings
    are loaded, not fitted again. To decode a label of your own, give its table and column:
    `probe-kit train RUN --labels labels.csv --target drawer --task classes`.
    """
    from probe_kit.runs import open_run
    from probe_kit.runs.direction_files import check_direction_file
    from probe_kit.train.results.probe_results import write_direction_file

    target_options = own.TargetOptions(target, labels, task, group_by, exchange_within, align_to)
    target_options.check(window)
    if test_on is None and (test_labels is not None or across_weights):
        option = "--test-labels" if test_labels is not None else "--across-weights"
        raise UsageError(f"{option} is for a transfer; give --test-on RUN too, or leave it out")
    if test_labels is not None and labels is None:
        raise UsageError("--test-labels with a built-in target; give --labels FILE too, or leave it out")
    opened = open_run(run, allow_partial=partial).in_wording(wording)
    options = {
        "views": views,
        "permutations": permutations,
        "token_permutations": token_permutations,
        "seed": seed,
        "window": window,
    }
    if test_on is not None:
        common.check_no_others(
            {
                "--controls": controls is not None, "--suite": suite, "--jobs": jobs, "--ray": ray,
                "--device": device, "--untrained": untrained, "--align-to": align_to,
                "--folds": folds != "groups", "--incomplete": incomplete != "keep",
                "--directions": directions,
            },
            "a transfer",
        )  # fmt: skip
        other = open_run(test_on, allow_partial=partial).in_wording(wording)
        options |= {"across_weights": across_weights, "call": _only_call(call, opened, "a transfer")}
        targets = target_options.read(opened, seed=seed), target_options.read(other, test_labels, seed)
        _transfer(opened, other, targets, categories, options, details)
        return
    control = None if untrained is None else open_run(untrained, allow_partial=partial).in_wording(wording)
    options |= {
        "folds": folds,
        "incomplete": incomplete,
        "controls": controls,
        "suite": suite,
        "untrained": control,
        "jobs": jobs,
        "device": device,
        "ray": ray,
    }
    if directions is not None:
        check_direction_file(directions)
        if target_options.is_label:
            raise UsageError(f"--directions with --target {target}: only probes of a side have directions")
        _only_call(call, opened, "--directions")
    fitted = _train(opened, target_options, categories, call, options, details)
    if directions is not None:
        count = write_direction_file(fitted[0].directions, directions, opened.weights_sha256)
        say(markup("{} directions: {}", count, directions))
    of_target = f" --target {shlex.quote(target)}" if target_options.is_label else ""
    say(markup("next: [bold]probe-kit retention {}{}[/]", as_argument(run), of_target))


def _train(
    run: "Run",
    target_options: own.TargetOptions,
    categories: Any,
    call: str,
    options: Mapping[str, Any],
    details: bool,
) -> "list[ProbeResults]":
    """Probe the target at the inferences that `call` names; print the best sites, and return the probes."""
    from probe_kit.train import train_probes
    from probe_kit.train.results.probe_results import best_sites_table
    from probe_kit.train.results.summary import best_sites_findings

    read = target_options.read(run, seed=options["seed"])
    if target_options.is_label:
        out.print(read.contents, markup=False, highlight=False)
    left_out: dict[int, Exception] = {}
    fitted: list[ProbeResults] = []
    for number in _calls(call, run):
        try:
            with progress() as bar:
                results = train_probes(
                    run,
                    categories,
                    target=read,
                    align_to=target_options.event(run),
                    call=number,
                    progress=counter(bar, f"sites, call {number}" if number else "sites"),
                    **options,
                )
        except (TooFewGroupsError, UnbalancedEpisodesError) as error:
            if call != "all" or number == 0:
                raise
            left_out[number] = error
            continue
        fitted.append(results)
    out.print(best_sites_table(fitted, splits=details))
    for number, reason in left_out.items():
        say(markup("[yellow]left out:[/] call {}: {}", number, reason))
    if not fitted[0].controls.comparisons:
        say(
            "signal is judged against chance only: add the control random-features, or --untrained RUN, a run "
            "with random weights"
        )
    for sentence in best_sites_findings(fitted[0]):
        out.print(sentence, markup=False, highlight=False)
    return fitted


def _transfer(
    run: "Run",
    other: "Run",
    targets: "tuple[Target, Target]",
    categories: Any,
    options: Mapping[str, Any],
    details: bool,
) -> None:
    """Fit probes of a target on `run`, score them on `other` with a progress bar, and print the scores."""
    from probe_kit.train import transfer_probes
    from probe_kit.train.transfer import transfer_sentences, transfer_table

    for contents in dict.fromkeys(target.contents for target in targets):
        out.print(contents, markup=False, highlight=False)
    with progress() as bar:
        results = transfer_probes(run, other, *targets, categories, progress=counter(bar, "sites"), **options)
    out.print(transfer_table(results, splits=details))
    for sentence in transfer_sentences(results):
        out.print(sentence, markup=False, highlight=False)
    say(markup("nothing was stored; [bold]transfer_probes[/] in Python gives every site as a frame"))


# -- what a run stores ---------------------------------------------------------------------------------------


def facts_table(inventory: "Inventory", more_lines: Mapping[str, str]) -> "Table":
    """Return a table of a run and of what is stored with it.

    Args:
        inventory: The run's facts and stored probes.
        more_lines: Texts of the lines below the facts, by name.
    """
    from rich.table import Table

    from probe_kit.runs.reader import full_name

    missing = inventory.planned - inventory.episodes
    outcomes = ", ".join(f"{name} {count}" for name, count in inventory.outcomes.items())
    facts = {
        "run": inventory.run,
        "model": full_name(inventory.model, inventory.random_weights),
        "weights": (inventory.weights_sha256 or "none (scripted)")[:12],
        "suite": inventory.suite,
        "settings": inventory.settings_sha256[:12],
        "episodes": f"{inventory.episodes} of {inventory.planned}" * (missing > 0) or str(inventory.episodes),
        "wordings": ", ".join(f"{name} {count}" for name, count in inventory.wordings.items()),
        "failed": str(inventory.failed or ""),
        "outcomes": outcomes,
        "success": "" if inventory.success is None else inventory.success.sentence,
        "bounds": inventory.bounds,
        "categories": ", ".join(inventory.categories),
        **inventory.streams,
        **{f"probes {probes.key}": _probes_in_words(probes, inventory) for probes in inventory.probes},
        **{
            f"unfinished {key}": f"a sweep of {plural(sites, 'site')} so far; "
            "the same `probe-kit train` continues it"
            for key, sites in inventory.unfinished.items()
        },
        **more_lines,
    }
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        if value:
            table.add_row(name, Text(value))
    return table


_STATES = {
    "used": "what `probe-kit retention` reads: the probes asked for last",
    "other": "read with --probes RUN=KEY",
    "label": "of a label of your own, read with `probe-kit retention RUN --target COLUMN`",
    "other episodes": "of other episodes than the run has now",
}


def _probes_in_words(probes: "StoredProbes", inventory: "Inventory") -> str:
    state, fitted = _STATES[probes.state], f"fitted {probes.created[:16].replace('T', ' ')} UTC"
    parts = [f"{state}; views {', '.join(probes.views)}", f"target {probes.target}"]
    parts += [f"{probes.permutations} label permutations"]
    parts += [f"{probes.token_permutations} for tokens"] * (probes.token_permutations > 0)
    parts += [f"seed {probes.seed}"]
    parts += [f"captured inference {probes.call}"] * (probes.call > 0)
    parts += [f"wording {probes.wording}"] * bool(probes.wording)
    parts += [f"only {', '.join(probes.categories)}"] * (probes.categories not in ((), inventory.categories))
    parts += [f"controls {', '.join(probes.controls)}"] * bool(probes.controls)
    return "; ".join([*parts, fitted])


def _calls(text: str, run: "RunReader") -> list[int]:
    """Return the requested captured inferences, each once."""
    if text == "all":
        return list(range(run.captured_calls))
    parts = split(text) or ()
    if not parts or not all(map(is_count, parts)):
        raise UsageError(f"--call {text!r}; expected numbers from 0, comma-separated, or all")
    return list(dict.fromkeys(map(int, parts)))


def _only_call(text: str, run: "RunReader", subject: str) -> int:
    """Return the number of the captured inference for a `subject` that is made from exactly one.

    Raises:
        UsageError: For several inferences.
    """
    numbers = _calls(text, run)
    if len(numbers) != 1:
        raise UsageError(f"--call {text!r} with {subject}; expected one number")
    return numbers[0]
