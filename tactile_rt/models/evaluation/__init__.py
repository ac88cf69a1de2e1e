"""Evaluation of a model on objects that it never saw: accuracy, robustness, open set."""
