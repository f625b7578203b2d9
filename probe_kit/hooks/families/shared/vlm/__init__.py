"""Code that vision-language models with text answers share."""
