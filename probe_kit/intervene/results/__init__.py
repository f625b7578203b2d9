"""Results of interventions, loaded from a run."""
