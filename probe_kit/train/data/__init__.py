"""What probes are fitted on: samples and labels of a run."""
