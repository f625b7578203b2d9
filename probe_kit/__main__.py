"""The `probe-kit` command, also as `python -m probe_kit`."""

from probe_kit._terminal.interruption import leave_at_once


def main() -> None:
    """Run the console script; a SIGTERM counts as Ctrl-C."""
    leave_at_once()
    from probe_kit.cli import main as run_command

    run_command()


if __name__ == "__main__":
    main()
