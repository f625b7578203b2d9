"""Stored interventions: settings, answers, selection."""
