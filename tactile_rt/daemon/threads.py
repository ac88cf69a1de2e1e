"""Names of threads that more than one module must know."""

__all__ = ["ADMISSION"]

ADMISSION = "tactile-rt admission"  # it loads a model, and is not to be torn out of that
