"""Text on the terminal and in notebooks."""
