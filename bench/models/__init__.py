"""Rigs for accuracy and speed of training: `tactile-rt bench models`."""
