"""The demo, and policies with known ground truth."""
