"""Prismatic vision-language models, native."""
