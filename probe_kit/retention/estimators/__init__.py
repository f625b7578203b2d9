"""Estimators of retention."""
