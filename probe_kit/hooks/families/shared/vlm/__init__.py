"""What vision-language models that answer in text share."""
