"""`probe-kit check-environment`."""

from dataclasses import asdict
from typing import Annotated

import typer

from probe_kit._terminal import options as common
from probe_kit._terminal.console import marked, out, print_json, say
from probe_kit._terminal.plain_text import terminal_safe
from probe_kit.extract.sources.environment import EnvOptions

FAILED = 1


def check_environment(
    environment: Annotated[
        str,
        typer.Argument(metavar="MODULE:CLASS", help="Your environment, or lerobot:TYPE such as lerobot:libero."),
    ],
    env_options: EnvOptions = None,
    as_json: common.AsJson = False,
) -> None:
    """Check an environment of your own against its contract, without a model.

    Two episodes of five actions are played, twice. Each check is one line: passed or failed, and the promise that
    is checked. A failure says what was seen and what was expected.

    Example: `probe-kit check-environment kitchen:Kitchen`

    Exits with 1 if a check failed.
    """
    from probe_kit.extract import EnvSource
    from probe_kit.extract import check_environment as checks_of

    source = EnvSource(environment, options=env_options or ())
    checks = []
    for check in checks_of(source):
        checks.append(check)
        if not as_json:
            state, colour = ("passed", "green") if check.passed else ("failed", "bold red")
            out.print(marked(f"[{colour}]{{}}[/] {{}}", f"{state:8}", check.sentence), soft_wrap=True)
            if check.problem:
                out.print(marked("         [dim]seen[/] {}", terminal_safe(check.problem)), soft_wrap=True)
    failed = sum(not check.passed for check in checks)
    if as_json:
        listed = [{**asdict(check), "passed": check.passed} for check in checks]
        print_json({"environment": environment, "passed": not failed, "checks": listed})
    elif failed:
        out.print(f"{len(checks) - failed} passed, {failed} failed")
    else:
        out.print(f"{len(checks)} passed")
        say(marked("next: [bold]probe-kit extract --model NAME --env {}[/] --out runs/own", environment))
    raise typer.Exit(FAILED if failed else 0)
