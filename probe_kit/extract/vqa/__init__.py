"""Questions in words to a model: prompts, phrases, parsing of answers, and option scores."""
