"""The exact solver of logistic probes."""
