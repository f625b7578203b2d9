"""Asking a model a question in words: prompts, what they name, what the answers say, and what the logits say."""
