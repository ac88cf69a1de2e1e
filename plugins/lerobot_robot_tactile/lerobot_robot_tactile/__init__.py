"""Tactile arrays for LeRobot: a robot that has another robot's joints and cameras, and sensors.

    lerobot-record --robot.type=tactile --robot.robot='{type: so101_follower, ...}' \\
        --robot.sensors='{finger: "serial:///dev/ttyACM0?codec=native"}'
"""

from lerobot_robot_tactile.config_tactile import TactileConfig
from lerobot_robot_tactile.tactile import Tactile

__all__ = ["Tactile", "TactileConfig"]
