"""Sessions: a run's model and observations, set up again."""
