"""Networks: lerobot's own classes at any size, and families no maintained package carries. No capture logic."""
