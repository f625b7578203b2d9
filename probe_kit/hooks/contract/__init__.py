"""The contract of a model family."""
