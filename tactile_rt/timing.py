"""How a touch is cut into steps: a network takes one at a time, and decides after each."""

from dataclasses import dataclass

__all__ = ["MOUSE", "STEPS", "STEP_MS", "Timing"]

STEPS, STEP_MS = 22, 45.0  # of a window (Chung et al. 2025)


@dataclass(frozen=True)
class Timing:
    """Steps of a window, with a decision after each, of `substeps` samples."""

    steps: int = STEPS
    substeps: int = 5

    @classmethod
    def of(cls, period_ns: int) -> "Timing":
        """For samples so far apart: steps as near to the paper's 45 ms as whole samples come."""
        return cls(substeps=max(1, round(STEP_MS * 1e6 / period_ns)))

    @property
    def samples(self) -> int:
        """The number of samples of a window."""
        return self.steps * self.substeps


MOUSE = Timing()  # 22 steps of five 9 ms samples
