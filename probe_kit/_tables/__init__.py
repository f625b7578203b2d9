"""One table for every command, with a renderer per format; see `probe_kit._tables.table`."""
