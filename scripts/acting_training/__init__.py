"""How policies are made of the embedded reader: demonstrations → frames → training → checkpoint."""
