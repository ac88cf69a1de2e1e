"""Faults of a robot's sensor that networks are trained with: drawn in training, never stored.

A sweep set holds the loads of sound whiskers. Each time that training takes a sweep, it draws the
sensor's faults anew, by these amounts, which the set's recipe may give.
"""

from dataclasses import dataclass, fields

from tactile_rt.core.errors import ConfigError

LARGEST = 100.0  # largest amount: a larger one is a typing error


@dataclass(frozen=True, kw_only=True)
class SensorFaults:
    """Amounts of the sensor faults that training draws.

    Attributes:
        noise: The largest noise, in units of the rated: a third of the sweeps have none, a third
            the rated, the others any up to this one.
        gain: The standard deviation of every whisker's relative gain error.
        dead: The probability that a whisker reads nothing.
        dead_row: The probability that a row of whiskers reads nothing.
        offset: The largest standard deviation of the constant that every channel has gained since
            its baseline, in units of its rated noise: half of the sweeps have no offset, the others
            draw a share of it uniformly.
        drift: The same for an offset that grows linearly until the end of a window.
        implausible: The probability of loads that no touch makes, which a network learns to name:
            channels swapped or turned, a gain far too large or small, half of the elements gone.

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
