"""Payloads: the numbers and words that the viewer's page shows, each a script that calls `put(name, value)`."""
