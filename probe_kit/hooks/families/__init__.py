"""One folder per model family: where to listen in it, how to load and how to verify it; beside them what is shared."""
