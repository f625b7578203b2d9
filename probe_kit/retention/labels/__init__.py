"""Retention of labels of your own: estimates, and the table that shows them."""
