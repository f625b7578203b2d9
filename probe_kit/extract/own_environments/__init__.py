"""Environments of the user's own as a source of observations: their contract, its check, and their rows."""
