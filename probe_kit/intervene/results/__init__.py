"""Results of interventions, read back from a run."""
