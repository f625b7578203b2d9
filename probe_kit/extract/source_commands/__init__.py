"""Commands about sources of observations beside scenes: data sets of recordings, own environments."""
