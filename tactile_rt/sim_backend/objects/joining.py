"""Patches of a surface joined with their neighbours, as long as the join is near enough."""

import heapq
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import Generic, TypeVar

__all__ = ["Joining"]

P = TypeVar("P")


class Joining(Generic[P]):
    """Patches that grow by being joined with neighbours, the smallest first.

    A join that was refused once stays so however the two grow, until it is asked with more
    indulgence.

    Args:
        patches: to begin from.
        sizes: of each.
        neighbours: pairs of numbers of patches.
    """

    def __init__(
        self, patches: Sequence[P], sizes: Iterable[float], neighbours: Iterable[tuple[int, int]]
    ) -> None:
        self._alive = dict(enumerate(patches))
        self._sizes = dict(enumerate(sizes))
        self._near: dict[int, set[int]] = {k: set() for k in self._alive}
        for a, b in neighbours:
            if a != b:
                self._near[a].add(b)
                self._near[b].add(a)
        self._new = count(len(patches))

    def __len__(self) -> int:
        return len(self._alive)

    @property
    def patches(self) -> list[P]:
        """Those that there are now."""
        return list(self._alive.values())

    def join(self, joined: Callable[[P, P], P | None]) -> None:
        """Join whatever can be.

        Args:
            joined: what two patches become together; None: they don't.
        """
        refused: dict[int, set[int]] = {k: set() for k in self._alive}
        queue = [
            (self._sizes[a] + self._sizes[b], a, b)
            for a, others in self._near.items()
            for b in others
            if a < b
        ]
        heapq.heapify(queue)
        while queue:
            _, a, b = heapq.heappop(queue)
            if a not in self._alive or b not in self._alive or b in refused[a]:
                continue
            patch = joined(self._alive[a], self._alive[b])
            if patch is None:
                refused[a].add(b)
                refused[b].add(a)
                continue
            c = next(self._new)
            self._alive[c], self._sizes[c] = patch, self._sizes.pop(a) + self._sizes.pop(b)
            self._near[c] = (self._near.pop(a) | self._near.pop(b)) - {a, b}
            refused[c] = refused.pop(a) | refused.pop(b)
            del self._alive[a], self._alive[b]
            for k in self._near[c]:
                self._near[k] -= {a, b}
                self._near[k].add(c)
                if k in refused[c]:
                    refused[k].add(c)
                else:
                    heapq.heappush(queue, (self._sizes[c] + self._sizes[k], c, k))
