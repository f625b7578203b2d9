"""Showing recorded frames to a policy: the stage that reads them, and the controller that only predicts."""
