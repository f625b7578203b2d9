"""Controls of a label: other inputs, and another network, for the same probe."""
