"""Networks: lerobot's classes at any size, and families without a maintained package. No capture logic."""
