"""Rigs for the simulator: `tactile-rt bench sim`."""
