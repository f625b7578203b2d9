"""Archives and data sets of a study: runs without activations, and every table, readable alone."""
