"""How the embedded default is made: demonstrations → pictures → batches → training → checkpoint."""
