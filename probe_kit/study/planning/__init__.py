"""The plan of a study: what is stored, what is missing and why, and what it takes."""
