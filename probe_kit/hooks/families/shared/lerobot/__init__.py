"""Code that lerobot's flow policies share."""
