"""Rigs and scripts that make the project's figures and pictures. They run from a checkout only."""
