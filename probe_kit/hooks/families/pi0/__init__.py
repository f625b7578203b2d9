"""pi0 through lerobot."""
