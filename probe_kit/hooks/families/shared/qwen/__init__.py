"""Models on Qwen's vision-language models: base adapters, and parts of the networks."""
