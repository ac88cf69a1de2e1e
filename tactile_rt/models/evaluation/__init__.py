"""Evaluation of a model on unseen objects: accuracy, robustness, open set."""
