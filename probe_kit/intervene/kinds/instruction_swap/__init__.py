"""Instruction swap: other words, or other noise, before the same scene."""
