"""The robot: its observations are those of the robot that it wraps, and the newest samples."""

import threading
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_tactile.config_tactile import TactileConfig
from tactile_rt.errors import SourceError
from tactile_rt.recording import StreamWriter
from tactile_rt.sources.opening import open_source
from tactile_rt.stream import Chunk, EndOfStream

__all__ = ["Sensor", "Tactile"]

POLL_S = 0.05
FIRST_S = 10.0  # until a sensor's first sample


class Sensor:
    """A source that is read all the time, in a thread.

    Args:
        name: The name of the sensor.
        url: What to open.
        history: The number of newest samples to keep.
        record: The folder to record every sample in; empty: none is recorded.
    """

    def __init__(self, name: str, url: str, history: int, record: str) -> None:
        self.name = name
        self._source = open_source(url)
        self.spec = self._source.spec
        self._newest = np.full((history, *self.spec.shape), np.nan, np.float32)
        self._error: Exception | None = None
        self._lock = threading.Lock()
        self._came, self._stop = threading.Event(), threading.Event()
        self._writer = None
        if record:
            # The rate of rotation is a day: it is the time in the name that is wanted.
            self._writer = StreamWriter(
                Path(record) / f"{name}.mcap", self._source, url=url, rotate_s=86_400
            )
        self._thread = threading.Thread(target=self._run, name=f"tactile {name}", daemon=True)
        self._thread.start()

    @property
    def names(self) -> list[str]:
        """The name of each number of `read`, in its order."""
        flat = [f"{self.name}.{e}.{c}" for e in self.spec.elements for c in self.spec.channels]
        if len(self._newest) == 1:
            return flat
        ago = range(len(self._newest) - 1, -1, -1)
        return [f"{name}.{k}" for k in ago for name in flat]

    def read(self) -> np.ndarray:
        """(history, element, channel) The newest samples, the oldest first, SI; where an element
        has no trustworthy value, its last one, and before any, 0.

        Raises:
            DeviceNotConnectedError: The sensor has failed, or is over.
        """
        if not self._came.wait(FIRST_S) and self._error is None:
            raise DeviceNotConnectedError(f"{self.name} gave no sample within {FIRST_S:g} s")
        if self._error is not None:
            raise DeviceNotConnectedError(f"{self.name}: {self._error}")
        with self._lock:
            return np.nan_to_num(self._newest)

    def close(self) -> None:
        """Stop reading, and end the recording."""
        self._stop.set()
        self._thread.join()
        if self._writer is not None:
            self._writer.close()
        self._source.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                chunk = self._source.read(POLL_S)
                if chunk is not None:
                    if self._writer is not None:
                        self._writer.push(chunk)
                    self._take(chunk)
        except EndOfStream:
            self._error = SourceError("its stream is over")
        except Exception as error:  # told to whoever reads next
            self._error = error
        self._came.set()

    def _take(self, chunk: Chunk) -> None:
        n = len(self._newest)
        values, valid = chunk.values[-n:], chunk.valid[-n:]
        with self._lock:
            last = self._newest[-1]
            for row, ok in zip(values, valid, strict=True):
                last = np.where(ok[:, None], row, last)
                self._newest = np.concatenate([self._newest[1:], last[None]])
        self._came.set()


class Tactile(Robot):
    """A robot, or none, and its tactile sensors."""

    config_class = TactileConfig
    name = "tactile"

    def __init__(self, config: TactileConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot = None if config.robot is None else make_robot_from_config(config.robot)
        self.sensors: list[Sensor] = []

    @property
    def cameras(self) -> dict[str, Any]:
        """The robot's own."""
        return getattr(self.robot, "cameras", {})

    @cached_property
    def _names(self) -> list[str]:
        """Of the sensors' numbers; a sensor must be opened to be known."""
        opened = self.sensors or self._open("")
        names = [name for sensor in opened for name in sensor.names]
        if opened is not self.sensors:
            _close(opened)
        return names

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        mine = dict.fromkeys(self._names, float)
        return {**(self.robot.observation_features if self.robot else {}), **mine}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return self.robot.action_features if self.robot else {}

    @property
    def is_connected(self) -> bool:
        return bool(self.sensors) and (self.robot is None or self.robot.is_connected)

    def connect(self, calibrate: bool = True) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        if self.robot is not None:
            self.robot.connect(calibrate)
        self.sensors = self._open(self.config.record)

    @property
    def is_calibrated(self) -> bool:
        return self.robot is None or self.robot.is_calibrated

    def calibrate(self) -> None:
        if self.robot is not None:
            self.robot.calibrate()

    def configure(self) -> None:
        if self.robot is not None:
            self.robot.configure()

    def get_observation(self) -> dict[str, Any]:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected")
        found = self.robot.get_observation() if self.robot else {}
        for sensor in self.sensors:
            found.update(zip(sensor.names, sensor.read().ravel().tolist(), strict=True))
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action if self.robot is None else self.robot.send_action(action)

    def disconnect(self) -> None:
        opened, self.sensors = self.sensors, []
        _close(opened)
        if self.robot is not None and self.robot.is_connected:
            self.robot.disconnect()

    def _open(self, record: str) -> list[Sensor]:
        if record:
            Path(record).mkdir(parents=True, exist_ok=True)
        opened: list[Sensor] = []
        try:
            for name, url in self.config.sensors.items():
                opened.append(Sensor(name, url, self.config.history, record))
        except BaseException:
            _close(opened)
            raise
        return opened


def _close(sensors: list[Sensor]) -> None:
    for sensor in sensors:
        sensor.close()
