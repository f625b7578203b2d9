"""`python -m probe_kit` is `probe-kit`."""

from probe_kit.start import main

main()
