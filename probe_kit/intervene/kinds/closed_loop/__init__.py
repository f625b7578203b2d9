"""Closed loop: whole episodes with an edit at every inference."""
