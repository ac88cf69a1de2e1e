"""Grids of experiments: networks tuned alike, trained and untrained, as in the paper's figure."""
