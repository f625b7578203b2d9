"""One folder per model family: where to listen, how to load, how to verify; beside them what several share."""
