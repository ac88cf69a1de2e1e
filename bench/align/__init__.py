"""Rigs for the brain benchmark: `tactile-rt bench align`."""
