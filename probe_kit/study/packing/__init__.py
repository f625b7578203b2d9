"""A study for others: archive, data set and report, made of stored runs without activations and readable alone."""
