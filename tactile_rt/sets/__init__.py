"""Sweep sets on disk: simulated or cut out of recordings, and read by training."""
