"""Named tables of a study, from stored runs alone."""
