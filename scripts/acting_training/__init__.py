"""How policies are made of the embedded VLM: demonstrations → frames → training → checkpoint."""
