"""`python -m probe_kit` is `probe-kit`."""

from probe_kit.cli import main

main()
