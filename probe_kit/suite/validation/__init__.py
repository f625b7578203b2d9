"""The rules a suite must keep: E rules make it unusable, W rules say what to look at before trusting numbers."""
