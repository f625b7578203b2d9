"""What lerobot's flow policies share."""
