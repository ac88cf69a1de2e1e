"""Errors that a caller may want to handle; the message of each is one clear line.

    TactileError
      +-- ConfigError       the user asked for something that cannot be (name, option, file)
      +-- SourceError       a device or stream broke
      +-- SpecMismatch      two array descriptions that must agree do not
      +-- RecordingError    a stored stream is damaged or of another version
      +-- ModelError        a model file is damaged or of another version

This module is separate from `stream`, which needs NumPy, so that a command starts quickly.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

LONGEST, WORD = 200, 80  # characters of a message, and of a word in it that is no path


def name_some(items: Iterable[str], most: int = 3, between: str = ", ") -> str:
    """Join the first items for a message, count the rest: ``a, b and 17 more``."""
    names = list(items)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(names[:most]) + more


def length(message: str) -> int:
    """Count a message's characters, at most 40 per word and none of a path."""
    return sum(min(len(word), WORD // 2) + 1 for word in message.split(" ") if "/" not in word)


def shorten(message: str) -> str:
    """Cut the middle out of long words, except paths, then out of a long message."""
    words = [
        word if len(word) <= WORD or "/" in word else f"{word[:30]}...{word[-20:]}"
        for word in message.split(" ")
    ]
    message = " ".join(words)
    return message if length(message) <= LONGEST else f"{message[:129]} ... {message[-65:]}"


class TactileError(Exception):
    """Base of all errors that a caller may want to handle. The message is one line."""


class ConfigError(TactileError):
    """The user asked for something impossible; the message names it and what to do."""


class SourceError(TactileError):
    """A device or stream broke; the message names it."""


class SpecMismatch(TactileError):
    """Two array descriptions that must agree differ; the message lists where."""


class RecordingError(TactileError):
    """A stored stream is damaged or of another version; the message names the file."""


class ModelError(TactileError):
    """A model file is damaged, unfit, or of another version or kind. The message says why."""


def describe_error(error: BaseException, most: int | None = None) -> str:
    """Return an error's message in one line, or its type if it has no message.

    Args:
        most: Largest number of characters of the message.
    """
    return " ".join(str(error).split())[:most] or type(error).__name__


@contextmanager
def explain_errors(
    kind: type[TactileError], before: str, after: str = ")", most: int | None = None
) -> Iterator[None]:
    """Convert any error in the block to `kind`; a `TactileError` passes unchanged.

    Args:
        before, after, most: Texts around the error's message, and its largest length, characters.
    """
    try:
        yield
    except TactileError:
        raise
    except Exception as error:  # parsers raise a dozen unrelated types
        raise kind(f"{before}{describe_error(error, most)}{after}") from None
