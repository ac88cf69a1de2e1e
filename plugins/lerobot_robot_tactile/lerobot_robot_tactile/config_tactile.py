"""What is given on LeRobot's command line."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots.config import RobotConfig

__all__ = ["TactileConfig"]


@RobotConfig.register_subclass("tactile")
@dataclass(kw_only=True)
class TactileConfig(RobotConfig):
    """A robot with tactile sensors.

    Attributes:
        sensors: The URL of each sensor by its name, as `tactile_rt.open_source` takes it.
        robot: The robot that carries them; none: sensors alone.
        history: The number of newest samples of each sensor in an observation.
        record: The folder in which every sample is recorded at the sensor's own rate, in
            NAME-TIME.mcap; empty: none is.
    """

    sensors: dict[str, str] = field(default_factory=dict)
    robot: RobotConfig | None = None
    history: int = 1
    record: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sensors:
            raise ValueError("--robot.sensors names no sensor: '{finger: \"serial:...\"}'")
        if self.history < 1:
            raise ValueError(f"--robot.history must be 1 or more, not {self.history}")

    @property
    def cameras(self) -> dict[str, Any]:
        """The robot's own."""
        return getattr(self.robot, "cameras", {})
