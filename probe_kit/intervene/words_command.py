"""The command `probe-kit words`: the units of feed-forward blocks in the words of the vocabulary."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from probe_kit._system.counting import plural
from probe_kit._terminal import options as common
from probe_kit._terminal.console import counter, err, markup, out, print_json, progress, say, whole_number
from probe_kit.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from probe_kit._tables.table import Table
    from probe_kit.intervene.vocabulary import ValueWords, WordMatch

_TERMS = (
    "score: logit of the token for the unit's value vector behind the model's final norm, as in the logit lens. "
    "A unit is evidence of a direction, not of its use: steer along it"
)


def words(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Model family; `probe-kit models` lists them.")],
    like: Annotated[
        common.Names | None,
        typer.Option(
            **common.LISTED,
            help="List only units whose first tokens hold one of these words, such as slow,careful, and compare "
            "their number with shuffled embeddings. A word must be a single token.",
        ),
    ] = None,
    layers: Annotated[
        common.Names | None,
        typer.Option(**common.LISTED, help="Blocks to read, counted from 0, such as 4,5. Default: all."),
    ] = None,
    tokens: Annotated[
        int,
        typer.Option(help="Number of a unit's first tokens: the best scores.", min=1, max=1000),
    ] = 10,
    units: Annotated[
        int, typer.Option(help="Most units to list: those with the best scores.", min=1, max=1_000_000)
    ] = 20,
    shuffles: Annotated[
        int,
        common.further_option(
            "--shuffles", help="With --like: number of shuffled embeddings to compare with.", min=1
        ),
    ] = 1000,
    seed: common.Seed = 0,
    out_file: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Write the listed units' value vectors as directions (.safetensors or .npz) for `probe-kit "
            "intervene --kind steer --direction FILE#NAME`.",
        ),
    ] = None,
    checkpoint: common.Checkpoint = None,
    model_options: common.ModelOptions = None,
    random_weights: common.RandomWeights = False,
    weights_seed: common.WeightsSeed = 0,
    device: common.Device = "cpu",
    as_json: common.AsJson = False,
) -> None:
    """Read what the units of every feed-forward block would say: their value vectors as tokens.

    A unit adds its value vector to the residual stream, times its activation. The model's final norm and head turn
    that vector into a score for every token. The first tokens of a unit show what it promotes, such as slow and
    careful.

    Only the backbone of a model with a vocabulary can be read: an action expert has no words.

    Example: `probe-kit words pi0-tiny --like red,blue,green`
    """
    from probe_kit.hooks.contract.declared import read_pairs
    from probe_kit.hooks.registry import find_family
    from probe_kit.intervene.vocabulary import check_family, value_words
    from probe_kit.runs.direction_files import check_direction_file

    blocks = None if layers is None else [_block(text) for text in layers]
    if out_file is not None:
        check_direction_file(out_file)
        if out_file.exists():
            raise UsageError(f"{out_file} exists; choose another --out or remove it")
    family = find_family(model)
    check_family(family)
    options = read_pairs(model_options or [])
    family.check(checkpoint, device, None, random_weights, options, weights_seed)  # before it loads for minutes
    with err.status("loading the model"):
        loaded = family.load(checkpoint, device, None, random_weights, options, weights_seed)
    with progress() as bar:
        value = value_words(loaded, blocks, tokens, counter(bar, "units"))
    match = None if like is None else value.match(like, shuffles, seed)
    rows = _listed_rows(value, like, units)
    if out_file is not None:
        value.write(out_file, loaded, rows.tolist())
    if as_json:
        print_json(_as_json(value, match, rows))
    else:
        out.print(_table(value, match, rows))
    if out_file is not None and len(rows):
        say(markup("wrote {} to {}. Steer along one: --kind steer --sites backbone.{} --roles all --direction {}",
                   plural(len(rows), "direction"), out_file, f"{value.blocks[rows[0]] + 1:02d}",
                   f"{out_file}#{value.direction_name(rows[0])}"))  # fmt: skip


def _block(text: str) -> int:
    number = whole_number(text)
    if number is None:
        raise UsageError(f"--layers has {text!r}; expected numbers of blocks, counted from 0, such as 4,5")
    return number


def _listed_rows(value: "ValueWords", like: common.Names | None, units: int) -> "NDArray[np.int64]":
    """Return the rows to list: those that match, most matches first, then the highest first score."""
    matches = np.zeros(len(value), np.int64) if like is None else value.matches(like)
    order: NDArray[np.int64] = np.lexsort((-value.scores[:, 0], -matches))
    if like is not None:
        order = order[matches[order] > 0]
    return order[:units]


def _as_json(value: "ValueWords", match: "WordMatch | None", rows: "NDArray[np.int64]") -> dict[str, object]:
    listed = [
        {
            "layer": int(value.blocks[row]), "unit": int(value.units[row]), "direction": value.direction_name(row),
            "tokens": value.words_of(row), "token_ids": value.token_ids[row].tolist(),
            "scores": value.scores[row].tolist(),
        }
        for row in rows
    ]  # fmt: skip
    result: dict[str, object] = {"model": value.family, "weights_sha256": value.weights, "units": len(value)}
    if match is not None:
        result["like"] = {
            "words": list(match.words), "token_ids": list(match.token_ids), "units": match.units,
            "expected": match.expected, "p": match.p, "shuffles": match.shuffles,
        }  # fmt: skip
    return {**result, "listed": listed}


def _table(value: "ValueWords", match: "WordMatch | None", rows: "NDArray[np.int64]") -> "Table":
    from probe_kit._tables.numbers import number, p_text
    from probe_kit._tables.table import Table

    lines = [
        (
            str(value.blocks[row]), str(value.units[row]),
            ", ".join(
                f"{word} {number(float(score), 1)}"
                for word, score in zip(value.words_of(row), value.scores[row], strict=True)
            ),
        )
        for row in rows
    ]  # fmt: skip
    read = f"{plural(len(value), 'unit')} of {value.family} were read"
    compared = ""
    if match is not None:
        p = p_text(match.p)
        compared = (
            f"{match.units} of them have {' or '.join(match.words)} among their first {value.token_ids.shape[1]} "
            f"tokens; {match.expected:.1f} would by chance (p {p if p.startswith('<') else f'= {p}'}, "
            f"{match.shuffles} shuffles of the embedding)"
        )
    return Table.of(
        f"What do units of the backbone say? {value.family}",
        ("layer", "unit", "first tokens, with scores"),
        lines,
        names=2,
        notes=(f"{read}, {len(rows)} are listed", compared, _TERMS),
        overflow="wrap",
    )
