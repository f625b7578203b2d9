"""The categories of the embedded suite, a module each."""
