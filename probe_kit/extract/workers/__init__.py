"""Scheduling of episodes on workers: this process, several processes, or actors on a Ray cluster."""
