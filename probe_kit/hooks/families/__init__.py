"""One folder per model family: where to listen in it, how to load it, how to verify it. What several share is here."""
