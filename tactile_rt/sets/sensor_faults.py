"""Sensor faults that training adds to sweeps at random; they are never stored.

A sweep set holds the loads of sound whiskers. Each time that training uses a sweep, it draws the
sensor's faults anew, with the amounts below, which the set's recipe may override.
"""

from dataclasses import dataclass, fields

from tactile_rt.core.errors import ConfigError

LARGEST = 100.0  # largest amount: a larger one is a typing error


@dataclass(frozen=True, kw_only=True)
class SensorFaults:
    """Amounts of the sensor faults that training draws.

    Attributes:
        noise: The largest noise, in units of the rated noise: a third of the sweeps get none, a
            third the rated noise, the others a random amount up to the largest.
        gain: The standard deviation of every whisker's relative gain error.
        dead: The probability that a whisker reads zero.
        dead_row: The probability that all whiskers of a row read zero.
        offset: The largest standard deviation of a constant added to every channel after the
            baseline, in units of the rated noise: half of the sweeps have no offset, for the others
            the standard deviation is drawn uniformly up to this one.
        drift: The same as `offset`, for an offset that grows linearly until the end of a window.
        implausible: The probability of loads that no touch produces, which a network learns to
            name: channels swapped or inverted, a far too large or small gain, missing elements.

    Raises:
        ConfigError: a probability outside [0, 1], or an amount below 0 or above `LARGEST`.
    """

    noise: float = 1.0
    gain: float = 0.1
    dead: float = 0.05
    dead_row: float = 0.0
    offset: float = 0.0
    drift: float = 0.0
    implausible: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(SensorFaults)):
            most = 1.0 if name.startswith(("dead", "implausible")) else LARGEST
            if not 0 <= getattr(self, name) <= most:
                raise ConfigError(
                    f"faults.{name} must be between 0 and {most:g}, not {getattr(self, name)}"
                )
