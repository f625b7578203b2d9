"""Controls: accuracies that probes must exceed."""
