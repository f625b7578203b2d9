"""Options of `probe-kit train`, by help panel."""

from pathlib import Path
from typing import Annotated

import typer

from probe_kit._terminal.options import SPEED, Names, choices, some_of
from probe_kit.statistics.folds import FoldUnit
from probe_kit.train.choices import BASELINES, Incomplete, Target

CONTROLS = "Controls"
STATISTICS = "Statistics"
MOST_PERMUTATIONS = 1_000_000
MEAN = Names(("mean",))

Categories = Annotated[
    Names | None,
    typer.Option(
        "--categories",
        parser=Names.parse,
        metavar="A,B,…",
        help="Categories, comma-separated. all: pool every episode. Default: each category of the run.",
    ),
]
Views = Annotated[
    Names,
    typer.Option(
        "--views",
        parser=Names.parse,
        metavar="A,B,…",
        help="Views of the tokens, comma-separated: mean, last, mean:ROLE, tokens, tokens:ROLE.",
    ),
]
ProbeTarget = Annotated[
    Target,
    typer.Option(
        "--target",
        help="Label to decode. correct: side of the correct picture. chosen: side where the cube was placed. "
        "shuffled: correct side, flipped for half of the items, as a control.",
    ),
]
Calls = Annotated[
    str,
    typer.Option(
        "--call",
        metavar="N,N,…|all",
        help="Captured inferences to probe, counted from 0, comma-separated. all: those with enough episodes. See "
        "`extract --captured-calls`.",
    ),
]

# -- controls -----------------------------------------------------------------------------------------------

Controls = Annotated[
    Names | None,
    typer.Option(
        "--controls",
        parser=some_of(BASELINES, none="none"),
        metavar=f"{choices(BASELINES)},…",
        help="Baselines that never see the model, comma-separated, or none. Default: random-features, if the "
        "pictures of the suite are available.",
        rich_help_panel=CONTROLS,
    ),
]
Untrained = Annotated[
    str | None,
    typer.Option(
        "--untrained",
        metavar="RUN",
        help="Run of the same episodes to subtract, usually with untrained weights.",
        rich_help_panel=CONTROLS,
    ),
]
Suite = Annotated[
    Path | None,
    typer.Option(
        "--suite",
        metavar="FOLDER",
        help="Suite folder of the run, for pixels and random-features. Default: the embedded suite.",
        rich_help_panel=CONTROLS,
    ),
]

# -- statistics ---------------------------------------------------------------------------------------------

Permutations = Annotated[
    int,
    typer.Option(
        "--permutations",
        min=0,
        max=MOST_PERMUTATIONS,
        help="Number of label permutations for p-values.",
        rich_help_panel=STATISTICS,
    ),
]
TokenPermutations = Annotated[
    int,
    typer.Option(
        "--token-permutations",
        min=0,
        max=MOST_PERMUTATIONS,
        help="Number of label permutations for token views.",
        rich_help_panel=STATISTICS,
    ),
]
Folds = Annotated[
    FoldUnit,
    typer.Option(
        "--folds",
        help="Items kept in one fold. groups: items that share a picture. concepts: also items about the same two "
        "concepts.",
        rich_help_panel=STATISTICS,
    ),
]
IncompleteItems = Annotated[
    Incomplete,
    typer.Option(
        "--incomplete",
        help="Items with one missing episode. keep: use the other episode. drop: leave it out.",
        rich_help_panel=STATISTICS,
    ),
]

# -- speed --------------------------------------------------------------------------------------------------

Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        min=1,
        max=1024,
        help="Number of processes. Default: 1, or one per core with --ray.",
        rich_help_panel=SPEED,
    ),
]
SolverDevice = Annotated[
    str | None,
    typer.Option(
        "--device",
        help="Fit on this device with torch, such as cuda, in one process. Default: fit with numpy.",
        rich_help_panel=SPEED,
    ),
]
