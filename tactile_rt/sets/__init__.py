"""Sweep sets on disk, simulated or cut out of recordings, as training reads them."""
