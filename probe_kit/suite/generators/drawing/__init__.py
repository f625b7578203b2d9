"""What the embedded categories draw."""
