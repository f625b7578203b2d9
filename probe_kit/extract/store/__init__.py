"""The run store: where runs are, their files, and how these are written, sealed, read and verified."""
