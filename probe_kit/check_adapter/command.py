"""`probe-kit check-adapter`."""

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from probe_kit._system.escaping import as_argument
from probe_kit._terminal import options as common
from probe_kit._terminal.console import err, markup, out, print_json, say
from probe_kit.errors import UsageError
from probe_kit.extract.parts import WeightsDtype

if TYPE_CHECKING:
    from probe_kit.hooks.conformance.check import CheckOutcome

Instructions = Annotated[
    list[str] | None,
    typer.Option(
        "--instruction",
        metavar="TEXT",
        help="An instruction that your tokenizer knows; repeatable. The first two must have different numbers of "
        "tokens, and any two the same number. Default: sentences of the embedded suite.",
    ),
]


def check_adapter(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Model family; `probe-kit models` lists them.")],
    checkpoint: common.Checkpoint = None,
    options: common.ModelOptions = None,
    instructions: Instructions = None,
    device: common.Device = "auto",
    dtype: WeightsDtype = None,
    as_json: common.AsJson = False,
) -> None:
    """Check an adapter against the contract, and make a run of two episodes with it.

    Use it while you write an adapter: `probe-kit new-adapter NAME` writes one that passes. Each check is one line:
    passed, failed or skipped, and the promise that is checked. A failure says what was seen, what was expected and
    what to change. Needs no pytest; `probe_kit.hooks.testing` runs the same checks as tests.

    Checks of loading copy the checkpoint, so give a tiny one of the same layout if yours is large.

    Example: `probe-kit check-adapter my-vla --checkpoint checkpoint`

    Exits with 1 if a check failed. Ctrl-C stops at any check; nothing is kept.
    """
    if instructions is not None and len(instructions) < 2:
        raise UsageError("one --instruction was given; give at least two, such as two of the same length")
    with err.status("loading the family"):
        from probe_kit.check_adapter.checking import outcomes, subjects_of

        subjects = subjects_of(model, checkpoint, options or [], instructions, device, dtype)
    results = []
    with ExitStack() as stack:
        for subject in subjects:
            stack.enter_context(subject)
        for outcome in outcomes(subjects):
            results.append(outcome)
            if not as_json:
                _print_outcome(outcome)
    failed = [outcome for outcome in results if outcome.state == "failed"]
    if as_json:
        print_json({"model": model, "passed": not failed, "checks": [outcome.to_json() for outcome in results]})
    else:
        _print_end(model, checkpoint, results)
    raise typer.Exit(1 if failed else 0)


def _print_outcome(outcome: "CheckOutcome") -> None:
    """Print one line; below a failed one the value seen, the value expected and the change to make."""
    colours = {"passed": "green", "failed": "bold red", "skipped": "yellow"}
    line = f"{outcome.sentence} ({outcome.reason})" if outcome.reason else outcome.sentence
    out.print(markup(f"[{colours[outcome.state]}]{{}}[/] {{}}", f"{outcome.state:8}", line), soft_wrap=True)
    if outcome.state == "failed":
        for label, name in (("seen", "actual"), ("expected", "expected"), ("change", "change")):
            out.print(markup("         [dim]{}[/] {}", f"{label:9}", getattr(outcome, name)), soft_wrap=True)


def _print_end(model: str, checkpoint: str | None, outcomes: "list[CheckOutcome]") -> None:
    """Print how many checks passed, and what to do next."""
    counts = {
        state: sum(outcome.state == state for outcome in outcomes) for state in ("passed", "failed", "skipped")
    }
    out.print(", ".join(f"{count} {state}" for state, count in counts.items()))
    if counts["failed"]:
        first = next(outcome for outcome in outcomes if outcome.state == "failed")
        say(markup("next: {}. Then run the same command again.", first.change.rstrip(".")))
    else:
        play = "extract" if any(outcome.name == "two_episodes_are_extracted" for outcome in outcomes) else "ask"
        subject = f"--model {as_argument(model)}"
        if checkpoint:
            subject += f" --checkpoint {as_argument(checkpoint)}"
        say(markup("next: [bold]probe-kit {} {}[/] --items 24", play, subject))
