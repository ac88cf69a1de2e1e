"""Errors that a caller may want to handle; the message of each is one clear line.

    TactileError
      +-- ConfigError       the user asked for something that cannot be (name, option, file)
      +-- SourceError       a device or stream broke
      +-- SpecMismatch      two array descriptions that must agree do not
      +-- RecordingError    a stored stream is damaged or of another version
      +-- ModelError        a model file is damaged or of another version

They are apart from `stream`, which needs numpy, so that a command starts quickly.
"""

__all__ = [
    "ConfigError",
    "ModelError",
    "RecordingError",
    "SourceError",
    "SpecMismatch",
    "TactileError",
]


class TactileError(Exception):
    """Base of all errors that a caller may want to handle; the message is one clear line."""


class ConfigError(TactileError):
    """The user asked for something that cannot be: the message names it and what to do."""


class SourceError(TactileError):
    """A device or stream broke; the message names it."""


class SpecMismatch(TactileError):
    """Two array descriptions that must agree differ; the message lists where."""


class RecordingError(TactileError):
    """A stored stream is damaged or of another version; the message names the file."""


class ModelError(TactileError):
    """A model file is damaged, incomplete or of another version; the message names the file."""
