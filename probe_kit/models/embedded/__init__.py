"""The embedded models: a small policy and the VLM it was made from."""
