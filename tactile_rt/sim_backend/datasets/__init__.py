"""Sweep sets on disk: recipes, the engines that make sets, their checksums and their cards."""
