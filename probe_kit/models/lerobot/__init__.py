"""lerobot's own policies at the size of a checkpoint."""
