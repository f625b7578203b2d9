"""Networks: lerobot's pi0 and pi0.5 at any size, and families without a maintained package. No capture logic."""
