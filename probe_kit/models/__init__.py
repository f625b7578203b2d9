"""Networks: pi0 and pi0.5 of lerobot at any size, and families without a maintained package. No capture logic."""
