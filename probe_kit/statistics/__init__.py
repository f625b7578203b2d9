"""Statistics shared by suite checks, probes and success rates: grouped folds, intervals, exact tests."""
