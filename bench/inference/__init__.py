"""Rigs for steps and windows of models: `tactile-rt bench inference`."""
