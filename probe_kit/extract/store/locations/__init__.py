"""Where a run lies: a folder, or a prefix in an object store."""
