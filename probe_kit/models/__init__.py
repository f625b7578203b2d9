"""The parts of networks and checkpoint files that all families use, and the words of the embedded models.

The network of a family stands in the family's folder, `probe_kit/hooks/families/<family>/network.py`.
"""
