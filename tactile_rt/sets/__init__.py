"""Sweep sets at rest, which simulation makes, recordings are cut into, and networks learn from."""
