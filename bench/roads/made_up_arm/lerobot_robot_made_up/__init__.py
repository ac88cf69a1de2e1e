"""An arm that is where it was told to be, and a hand that tells it: LeRobot finds both."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("shoulder.pos", "elbow.pos")


@RobotConfig.register_subclass("made_up_arm")
@dataclass(kw_only=True)
class MadeUpArmConfig(RobotConfig):
    """An arm without options, but for the cameras that LeRobot asks every robot for."""

    cameras: dict[str, Any] = field(default_factory=dict)


class MadeUpArm(Robot):
    """An arm that says when it is released."""

    config_class, name = MadeUpArmConfig, "made_up_arm"
    action_features: Any = dict.fromkeys(JOINTS, float)
    observation_features: Any = dict.fromkeys(JOINTS, float)
    is_connected: Any = False
    is_calibrated: Any = True

    def __init__(self, config: MadeUpArmConfig) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {}
        self._where = dict.fromkeys(JOINTS, 0.0)

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        return dict(self._where)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self._where = dict(action)
        return action

    def disconnect(self) -> None:
        self.is_connected = False
        print("the arm is released")  # noqa: T201


@TeleoperatorConfig.register_subclass("made_up_hand")
@dataclass(kw_only=True)
class MadeUpHandConfig(TeleoperatorConfig):
    """A hand without options."""


class MadeUpHand(Teleoperator):
    """A hand that holds still."""

    config_class, name = MadeUpHandConfig, "made_up_hand"
    action_features: Any = dict.fromkeys(JOINTS, float)
    feedback_features: Any = dict.fromkeys(())
    is_connected: Any = False
    is_calibrated: Any = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, 0.5)

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self.is_connected = False
