"""Code that models on Qwen's vision-language models share."""
