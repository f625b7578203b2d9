"""OpenVLA, native."""
