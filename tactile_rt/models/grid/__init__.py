"""Grids of experiments: many networks, trained and untrained, tuned by the same procedure."""
