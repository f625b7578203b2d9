"""Transfer: probes of a label that are fitted on one run and scored on another; see `transfer`."""
