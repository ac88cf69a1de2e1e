"""Sweep sets on disk: recipes, the engines that make them, their checksums and their card."""
