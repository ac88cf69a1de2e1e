"""What is wrong with a robot's sensor, and a network has to be taught: drawn, never stored.

A sweep set keeps the loads of sound whiskers. Each time that training takes a sweep it draws what
is wrong with the sensor this time, by these amounts, which the set's recipe may say.
"""

from dataclasses import dataclass, fields

from tactile_rt.core.errors import ConfigError

LARGEST = 100.0  # of amounts: beyond it is a slip of the pen


@dataclass(frozen=True, kw_only=True)
class SensorFaults:
    """How a sensor is drawn for training.

    Attributes:
        noise: The largest noise, in units of the rated: a third of the sweeps have none, a third
            the rated, the others any up to this one.
        gain: The standard deviation of every whisker's relative gain error.
        dead: The probability of each whisker to read nothing.
        dead_row: The probability of each row of whiskers to read nothing.
        offset: The standard deviation of the constant that every channel has got since its
            baseline, in units of its rated noise: at most, as half of the sweeps have none, and the
            others draw a share of it evenly.
        drift: The same of what has come to it by the end of a window, growing evenly.
        implausible: The probability of loads that no touch makes, which a network learns to name:
            channels swapped or turned, a gain that is wrong by far, half of the elements gone.

    Raises:
        ConfigError: a probability that is none, or an amount below 0 or far too large.
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
