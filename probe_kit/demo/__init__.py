"""The demo, and the policies with known truth."""
