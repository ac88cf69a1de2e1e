"""Rigs for the drivers: `tactile-rt bench drivers`."""
