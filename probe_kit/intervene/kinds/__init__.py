"""The kinds of intervention, a folder each."""
