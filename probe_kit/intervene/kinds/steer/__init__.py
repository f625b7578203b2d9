"""Steering: add a direction to the tokens of a site."""
