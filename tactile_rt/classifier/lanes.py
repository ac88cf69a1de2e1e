"""Overlapping windows, each computed exactly: one lane of the batch per phase.

A network with state can answer for one window only, the one that began when its state was zero.
With windows of n steps that begin every k steps, ceil(n / k) copies of the state run side by side,
and each is zeroed when it is its turn to begin.
"""

from tactile_rt.stream import ConfigError

__all__ = ["Lanes"]


class Lanes:
    """Which lane begins before a step, and which is asked after it; steps are counted from 0.

    Args:
        steps: of a window.
        every: steps from one window's beginning to the next one's.

    Attributes:
        count: lanes.

    Raises:
        ConfigError: `every` is not from 1 to `steps`.
    """

    def __init__(self, steps: int, every: int) -> None:
        if not 1 <= every <= steps:
            raise ConfigError(f"every: {every} steps; windows of {steps} take 1 to {steps}")
        self.steps, self.every = steps, every
        self.count = -(-steps // every)

    def beginning(self, step: int) -> int | None:
        """The lane whose window begins with a step, or None."""
        return step // self.every % self.count if step % self.every == 0 else None

    def asked(self, step: int) -> tuple[int, int] | None:
        """The lane to ask after a step, and its own step counted from 1; or None.

        Until the first window is complete, that is the first window's lane.
        """
        if step < self.steps:
            return 0, step + 1
        begun = step + 1 - self.steps
        return (begun // self.every % self.count, self.steps) if begun % self.every == 0 else None
