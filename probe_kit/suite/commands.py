"""The command `probe-kit suite`: build, convert, check and show suites."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from probe_kit._system.bounded_files import load_json, parse_json
from probe_kit._system.counting import plural
from probe_kit._system.escaping import as_argument
from probe_kit._terminal.console import counter, err, markup, out, print_json, progress
from probe_kit._terminal.options import AsJson, Categories, Seed, choices, one_of
from probe_kit.errors import UsageError
from probe_kit.suite.converters.conversion import EVERY_SOURCE

if TYPE_CHECKING:
    from probe_kit.suite import Suite

app = typer.Typer(help="Build, convert, check and show suites of questions.", no_args_is_help=True)

ShownSuite = Annotated[
    Path | None, typer.Argument(metavar="[FOLDER]", help="Suite folder. Default: the embedded suite.")
]
OutFolder = Annotated[Path, typer.Option("--out", metavar="FOLDER", help="New folder for the suite.")]
REVIEW = "Review"


@app.command("build")
def build(
    folder: Annotated[Path, typer.Argument(help="New folder for the suite.")],
    categories: Categories = None,
    n: Annotated[
        int, typer.Option("--n", help="Number of items per category, an even number.", max=100_000)
    ] = 150,
    seed: Seed = 0,
) -> None:
    """Draw the embedded suite and save it in FOLDER."""
    from probe_kit.suite import build_suite

    with progress() as bar:
        drawing = counter(bar, "drawing items")
        suite = build_suite(folder, categories, n, seed, progress=drawing)
    out.print(
        f"{suite.identity}: {plural(len(suite.items), 'item')}, "
        f"{plural(2 * len(suite.items), 'episode')} in {folder}"
    )


@app.command("from-csv")
def from_csv(
    table: Annotated[
        Path, typer.Argument(help="CSV: instruction,correct,wrong[,group,category,object,other_object].")
    ],
    out_folder: OutFolder,
    license_name: Annotated[
        str | None,
        typer.Option("--license", help="Licence of the pictures (SPDX), such as CC0-1.0. Required."),
    ] = None,
    attribution: Annotated[
        str, typer.Option(help="Author to credit for the pictures.")
    ] = "the author of the table",
    category: Annotated[str, typer.Option(help="Category of the rows that name none.")] = "questions",
    name: Annotated[
        str | None, typer.Option(help="Name of the suite. Default: the file name of the table.")
    ] = None,
    real_faces: Annotated[
        bool, typer.Option("--real-faces", help="Declare that some pictures show real people.")
    ] = False,
) -> None:
    """Make a suite from your own questions: a row per question, with paths of pictures relative to the table.

    \b
    instruction,correct,wrong,group,category
    Put the cube on the ripe fruit,banana-3.jpg,banana-1.jpg,banana,ripeness

    Rows of one group, or with a common picture, are never split between training and test. Every row is played
    with the answer on the left and on the right.
    """  # noqa: D301 - click reads the \b
    from probe_kit.suite import Terms, suite_from_csv

    if license_name is None:
        raise UsageError(
            "--license is missing; a suite stores what others may do with its pictures. For your own pictures "
            "choose one: --license CC0-1.0 (they may do anything), CC-BY-4.0 (they must name you) or "
            "LicenseRef-not-for-others. For pictures of others give the licence under which you got them"
        )
    terms = Terms(license_name, attribution, contains_real_face=real_faces)
    suite = suite_from_csv(table, out_folder, name=name, category=category, terms=terms)
    count, groups = len(suite.items), len({item.group_id for item in suite.items})
    out.print(
        f"{suite.identity}: {plural(count, 'item')} in {plural(groups, 'group')} in {out_folder}", soft_wrap=True
    )
    err.print(f"next: probe-kit suite validate {as_argument(out_folder)} --baselines", soft_wrap=True)
    err.print(
        f"then: probe-kit extract --model pi0-tiny --suite {as_argument(out_folder)} "
        f"--out {as_argument(f'runs/{out_folder.name}-questions')}",
        soft_wrap=True,
    )


@app.command("show")
def show(
    folder: ShownSuite = None,
    categories: Categories = None,
    n: Annotated[
        int, typer.Option("--n", min=1, help="Show only this many items per category, the first ones.")
    ] = 4,
    counts: Annotated[
        bool, typer.Option("--counts", help="List the categories with their item counts instead.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List items of a suite: the instruction, the picture that answers it, and the other picture."""
    from probe_kit.suite import default_suite, load_suite

    suite = default_suite() if folder is None else load_suite(folder)
    suite = suite.select(categories)
    if counts:
        _list_categories(suite, as_json)
        return
    rows = [
        {
            "category": item.category,
            "item": item.item_id,
            "instruction": item.instruction,
            "correct": str(item.picture(item.correct_side)),
            "wrong": str(item.picture("right" if item.correct_side == "left" else "left")),
        }
        for category in suite.categories
        for item in [item for item in suite.items if item.category == category][:n]
    ]
    if as_json:
        print_json({"suite": suite.identity, "items": rows})
        return
    out.print(markup("[bold]{}[/]", suite.identity), soft_wrap=True)
    working_folder = Path.cwd()
    for row in rows:
        # Each path on a line of its own: a column of a table would fold it, so that it could not be copied.
        paths = {side: Path(row[side]) for side in ("correct", "wrong")}
        pictures = {
            side: str(path.relative_to(working_folder) if path.is_relative_to(working_folder) else path)
            for side, path in paths.items()
        }
        out.print(markup("\n[bold]{}[/]", row["instruction"]), soft_wrap=True)
        for name, text in {"category": row["category"], "item": row["item"], **pictures}.items():
            out.print(markup("  {} {}", f"{name:<8}", text), soft_wrap=True)


def _list_categories(suite: "Suite", as_json: bool) -> None:
    from rich.table import Table

    from probe_kit.suite.categories import category_of
    from probe_kit.suite.suite import count_by_category

    counts = count_by_category(suite.items)
    if as_json:
        print_json({"suite": suite.identity, "items": counts})
        return
    table = Table("category", "title", "domain", "items", "episodes", title=suite.identity)
    for column in table.columns:
        column.overflow = "fold"
    for slug, count in counts.items():
        category = category_of(slug)
        table.add_row(slug, category.title, category.domain, str(count), str(2 * count))
    out.print(table)


@app.command()
def validate(
    folder: ShownSuite = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Also test for leaks through pixels, text or side alone.")
    ] = False,
    power: Annotated[
        bool,
        typer.Option(
            "--power", help="Also print the smallest leak that the tests can detect in a suite of this size."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check every rule of the item format; exit with 1 if one is violated.

    With --baselines, probes on the pictures, the instruction or the side alone must be at chance.
    """
    from probe_kit.statistics.significance import detectable
    from probe_kit.suite import default_suite, load_suite, validate_suite
    from probe_kit.suite.suite import count_by_category

    location = default_suite().folder if folder is None else folder
    with err.status("checking"):
        report = validate_suite(location, baselines=baselines)
    least: dict[str, float] = {}
    if power and not report.errors:  # the accuracy from which on a leak is found in four of five suites
        counts = count_by_category(load_suite(location).items)
        least = {name: detectable(count) for name, count in counts.items()}
    if as_json:
        print_json(report.to_json() | ({"power": least} if power else {}))
    else:
        for category, accuracy in least.items():
            line = f"{category}: a leak is found in 4 of 5 suites of this size from {100 * accuracy:.1f} % on"
            out.print(line, soft_wrap=True)
        out.print(report.to_text(), soft_wrap=True)
    raise typer.Exit(0 if report.ok else 1)


@app.command()
def convert(
    source: Annotated[
        str,
        typer.Argument(parser=one_of(EVERY_SOURCE), metavar=choices(EVERY_SOURCE), help="Benchmark to convert."),
    ],
    root: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the unpacked benchmark.")],
    out_folder: OutFolder,
    categories: Categories = None,
    n: Annotated[int, typer.Option("--n", help="Largest number of items per category.", max=1_000_000)] = 150,
    seed: Seed = 0,
    curation: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Use only the items that this reviewed file accepts.", rich_help_panel=REVIEW
        ),
    ] = None,
    emit_curation: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a file in which you accept or reject each item, with previews of the pictures.",
            rich_help_panel=REVIEW,
        ),
    ] = None,
    option: Annotated[
        list[str] | None,
        typer.Option(
            "--option", "-o", metavar="NAME=VALUE", help="Set an option of the benchmark, such as min_side=64."
        ),
    ] = None,
) -> None:
    """Convert a benchmark to a suite and compare the count of every stage with the paper."""
    from probe_kit.suite.converters import convert as convert_source
    from probe_kit.suite.suite import count_by_category

    with err.status("converting"):
        suite = convert_source(
            source,
            root,
            out_folder,
            categories=categories,
            n=n,
            seed=seed,
            curation=curation,
            emit_curation=emit_curation,
            **_options(option or []),
        )
    counts = ", ".join(f"{category} {count}" for category, count in count_by_category(suite.items).items())
    out.print(f"{suite.identity}: {counts} items in {out_folder}", soft_wrap=True)
    if reasons := load_json(out_folder / "stats.json").get("reasons"):
        left_out = "; ".join(f"{reason} {count}×" for reason, count in reasons.items())
        err.print(markup("records left out: {}", left_out), soft_wrap=True)


def _options(pairs: list[str]) -> dict[str, Any]:
    """Parse NAME=VALUE pairs; a value that is valid JSON is read as such, anything else is text."""
    options = {}
    for pair in pairs:
        name, separator, value = pair.partition("=")
        if not separator:
            raise UsageError(f"--option {pair!r} has no value; write NAME=VALUE, such as min_side=64")
        key = name.replace("-", "_")
        if key in options:
            raise UsageError(f"--option {name} is given twice; give it once")
        try:
            options[key] = parse_json(value)
        except ValueError:
            options[key] = value
    return options
