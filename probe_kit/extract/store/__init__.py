"""The run store: where a run lies, what its files are, how they are written, sealed, read and audited."""
