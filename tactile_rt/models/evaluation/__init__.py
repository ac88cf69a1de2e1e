"""How good a model is on objects that it never saw: accuracy, robustness, open-set decisions."""
