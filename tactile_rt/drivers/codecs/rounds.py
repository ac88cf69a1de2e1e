"""Samples that a device sends in parts, each in a frame that says which part it is."""

from typing import Generic, TypeVar

__all__ = ["Rounds"]

T = TypeVar("T")


class Rounds(Generic[T]):
    """Puts parts together: a device sends 0 to n - 1 in ascending order, then begins again.

    A round ends with part n - 1, or when a part comes that is not after the one before. Nothing
    tells that a round was lost whole, or that two halves of two rounds were.

    Args:
        parts: n.
    """

    def __init__(self, parts: int) -> None:
        self._n = parts
        self.forget()

    def forget(self) -> None:
        """Begin anew; what is left of a round that we entered in the middle is no loss."""
        self._parts: list[T | None] = [None] * self._n
        self._last = -1
        self._entered = False
        self._newest: tuple[int, T] | None = None

    def add(self, index: int, part: T) -> list[list[T | None]]:
        """Take a part; return the rounds that it ends (none, one or two), None for parts not come.

        Args:
            index: which part, from 0 to n - 1.
            part: what came.
        """
        # CAN may deliver a frame twice when its end is disturbed
        if self._n > 1 and self._newest == (index, part):
            return []
        self._newest = (index, part)
        ended: list[list[T | None]] = []
        if index <= self._last:
            ended += self._end()
        self._parts[index] = part
        self._last = index
        if index == self._n - 1:
            ended += self._end()
        return ended

    def end(self) -> list[list[T | None]]:
        """End the round that has begun, if one has."""
        return self._end() if self._last >= 0 else []

    def _end(self) -> list[list[T | None]]:
        parts, self._parts, self._last = self._parts, [None] * self._n, -1
        entered, self._entered = self._entered, True
        return [parts] if entered or parts[0] is not None else []
