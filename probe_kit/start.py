"""Where the `probe-kit` command begins."""

from probe_kit._terminal.interruption import leave_at_once


def main() -> None:
    """Entry point of the console script and of `python -m probe_kit`; a SIGTERM counts as Ctrl-C."""
    leave_at_once()
    from probe_kit.cli import main as run_command

    run_command()
