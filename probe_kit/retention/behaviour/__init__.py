"""The behaviour of a run: success rates, answers, wordings."""
