"""What networks of all families are built of and read with, and the embedded models' words and checkpoints.

The network of a family stands in the family's folder, `probe_kit/hooks/families/<family>/network.py`.
"""
