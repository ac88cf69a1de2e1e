"""What is given on LeRobot's command line."""

import re
from dataclasses import dataclass, field
from typing import Any

import draccus
from lerobot.robots.config import RobotConfig

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
LONGEST = 100  # samples in an observation


@RobotConfig.register_subclass("tactile")
@dataclass(kw_only=True)
class TactileConfig(RobotConfig):
    """A robot with tactile sensors.

    Attributes:
        sensors: The URL of each sensor by its name, as `tactile_rt.open_source` takes it.
        robot: The configuration of the robot that carries them, with its ``type``, as in
            ``{type: so101_follower, port: /dev/ttyACM0}``; none: sensors alone. Its ``id`` and
            ``calibration_dir`` are those of this one unless it has its own.
        history: The number of newest samples of each sensor in an observation, 1 to 100.
        max_age_s: The age from which on a reading is stale, s; 0: three sample periods of the
            sensor, and at least 0.1.
        on_stale: ``error`` ends the recording or policy when a sensor is stale; ``nan`` goes on
            with NaN for what it does not measure.
        record: The folder in which every sample is recorded at the sensor's own rate, in
            NAME-TIME.mcap; empty: none is.
    """

    sensors: dict[str, str] = field(default_factory=dict)
    # A RobotConfig once it is read. Not declared as one: the parser offers every type of robot for
    # it, this one included, with all of their options and so on without end.
    robot: dict[str, Any] | str | None = None
    history: int = 1
    max_age_s: float = 0.0
    on_stale: str = "error"
    record: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.sensors, dict) or not self.sensors:
            raise ValueError("--robot.sensors names no sensor: '{finger: \"serial:...\"}'")
        for name, url in self.sensors.items():
            if not NAME.fullmatch(str(name)):
                raise ValueError(
                    f"--robot.sensors: {name!r} is no name: letters, digits, - and _, then a colon "
                    "and a space"
                )
            if not isinstance(url, str) or ":" not in url:
                raise ValueError(f"--robot.sensors: {name}: {url!r} is no URL, as serial:... is")
        if not isinstance(self.history, int) or not 1 <= self.history <= LONGEST:
            raise ValueError(
                f"--robot.history must be 1 to {LONGEST}, not {self.history!r}; `record` has all"
            )
        if not isinstance(self.max_age_s, int | float) or not 0 <= self.max_age_s < float("inf"):
            raise ValueError(f"--robot.max_age_s must be 0 or more, not {self.max_age_s!r}")
        if self.on_stale not in ("error", "nan"):
            raise ValueError(f"--robot.on_stale must be error or nan, not {self.on_stale!r}")
        self.robot = self._read_carrier()

    @property
    def cameras(self) -> dict[str, Any]:
        """The cameras of the robot that carries the sensors."""
        return getattr(self.robot, "cameras", {})

    def _read_carrier(self) -> RobotConfig | None:
        """Read the configuration of the robot that carries the sensors.

        Raises:
            ValueError: it names no type, or one that LeRobot does not know.
        """
        robot: Any = {"type": self.robot} if isinstance(self.robot, str) else self.robot
        if robot is None or isinstance(robot, RobotConfig):
            return robot
        if "type" not in robot:
            raise ValueError("--robot.robot names no type: '{type: so101_follower, port: ...}'")
        known = sorted(set(RobotConfig.get_known_choices()) - {"tactile"})
        if robot["type"] not in known:
            raise ValueError(
                f"--robot.robot: {robot['type']!r} is no type of robot: {', '.join(known)}"
            )
        same = {"id": self.id, "calibration_dir": self.calibration_dir}
        given = {key: str(value) for key, value in same.items() if value is not None}
        return draccus.decode(RobotConfig, {**given, **robot})
