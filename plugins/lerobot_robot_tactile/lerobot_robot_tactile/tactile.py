"""The robot: its observations are those of the robot that it wraps, and the newest samples."""

import logging
import threading
import time
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.robots import Robot, make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_tactile.config_tactile import TactileConfig
from tactile_rt.core.errors import ConfigError, SourceError, TactileError
from tactile_rt.core.stream import Chunk, EndOfStream
from tactile_rt.recording import StreamWriter
from tactile_rt.sources.opening import open_source

POLL_S = 0.05
FIRST_S = 10.0  # until a sensor's first sample
PERIODS, LEAST_AGE_S = 3, 0.1  # the age limit where none is given
NEVER = -(2**62)  # ns


class Sensor:
    """A source that is read all the time, in a thread.

    Args:
        name: The name of the sensor.
        url: What to open.
        history: The number of newest samples to keep.
        max_age_s: The age from which on a value is stale, s; 0: three sample periods, and at least
            0.1 s.
        record: The folder to record every sample in; empty: none is recorded.

    Attributes:
        max_age_s: The age from which on a value is stale, s.
    """

    def __init__(
        self, name: str, url: str, history: int = 1, max_age_s: float = 0.0, record: str = ""
    ) -> None:
        self.name = name
        self._source = open_source(url)
        self.spec = self._source.spec
        self.max_age_s = max_age_s or max(PERIODS / self.spec.rate_hz, LEAST_AGE_S)
        # Of the newest samples, replaced as a whole: host time, ns (history,); the last valid
        # values (history, element, channel); and when those were taken, ns (history, element).
        self._newest = (
            np.zeros(history, np.int64),
            np.full((history, *self.spec.shape), np.nan, np.float32),
            np.full((history, len(self.spec.elements)), NEVER, np.int64),
        )
        self._error: Exception | None = None
        self._unrecorded = ""  # why the recording has ended
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
        ago = range(len(self._newest[0]) - 1, -1, -1)
        values = flat if len(ago) == 1 else [f"{name}.{k}" for k in ago for name in flat]
        return [*values, f"{self.name}.age_ms", f"{self.name}.valid"]

    def wait(self) -> None:
        """Wait for the first sample.

        Raises:
            DeviceNotConnectedError: None came within 10 s, or the sensor has failed.
        """
        if not self._came.wait(FIRST_S):
            raise DeviceNotConnectedError(f"{self.name} gave no sample within {FIRST_S:g} s")
        if self._error is not None:
            raise DeviceNotConnectedError(f"{self.name}: {self._error}")

    def diagnose(self) -> str:
        """Say why the sensor cannot be relied on now; empty if it can."""
        if self._error is not None:
            return f"{self.name}: {self._error}"
        if self._unrecorded:
            return f"{self.name} is not recorded: {self._unrecorded}"
        age_s = self.read()[-2] / 1e3
        if age_s <= self.max_age_s:
            return ""
        since = f"for {age_s:.2g} s" if age_s > 0 else "yet"
        return f"{self.name} has given no valid sample {since}: is it plugged in and running?"

    def read(self) -> list[float]:
        """Return the newest samples, their age and how much of them is valid, as `names` says.

        Values are in SI units, the oldest sample first. An element keeps its last valid value for
        `max_age_s`; then, and before its first, it is NaN. The age is that of the newest valid
        value of any element, ms; NaN before the first. Valid is the share of elements that have a
        value now, 0 to 1.
        """
        now = time.monotonic_ns()
        t_ns, values, valid_ns = self._newest
        held = np.append(t_ns[:-1], now)[:, None] - valid_ns <= 1e9 * self.max_age_s
        held &= held[-1].any()  # when nothing comes, what came before tells nothing of now
        newest = int(valid_ns[-1].max())
        age_ms = (now - newest) / 1e6 if newest > NEVER else float("nan")
        shown = np.where(held[..., None], values, np.nan)
        return [*shown.ravel().tolist(), age_ms, float(held[-1].mean())]

    def close(self) -> None:
        """Stop reading, and end the recording."""
        self._stop.set()
        self._thread.join()
        try:
            if self._writer is not None:
                self._writer.close()
        finally:
            self._source.close()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                chunk = self._source.read(POLL_S)
                if chunk is not None:
                    self._take(chunk)
                    self._record(chunk)
        except EndOfStream:
            self._error = SourceError("its stream is over")
        except Exception as error:  # told to whoever reads next
            self._error = error
        self._came.set()

    def _record(self, chunk: Chunk) -> None:
        if self._writer is None or self._unrecorded:
            return
        try:
            self._writer.push(chunk)
        except Exception as error:  # as of a full disk: touch itself goes on
            self._unrecorded = str(error) or type(error).__name__

    def _take(self, chunk: Chunk) -> None:
        now, n = chunk.t_ns, len(self._newest[0])
        if not self._source.live:  # a recording's times are those of another day
            now = now - now[-1] + time.monotonic_ns()
        t_ns, values, valid_ns = self._newest
        for t, row, ok in zip(now[-n:], chunk.values[-n:], chunk.valid[-n:], strict=True):
            t_ns = np.append(t_ns[1:], t)
            last = np.where(ok[:, None], row, values[-1])
            values = np.concatenate([values[1:], last[None]])
            valid_ns = np.concatenate([valid_ns[1:], np.where(ok, t, valid_ns[-1])[None]])
        self._newest = t_ns, values, valid_ns
        self._came.set()


class Tactile(Robot):
    """A robot, or none, and its tactile sensors."""

    config_class = TactileConfig
    name = "tactile"

    def __init__(self, config: TactileConfig) -> None:
        super().__init__(config)
        self.config = config
        self.robot: Any = None
        if config.robot is not None:
            self.robot = make_robot_from_config(config.robot)
        self.sensors: list[Sensor] = []
        self._diagnosed: set[str] = set()  # sensors of which that has been logged

    @property
    def cameras(self) -> dict[str, Any]:
        """The robot's own."""
        return getattr(self.robot, "cameras", {})

    @cached_property
    def _names(self) -> list[str]:
        """The sensors' features; a sensor must be opened to be known."""
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
        """True while the robot is connected and every sensor measures.

        With ``on_stale=nan`` a sensor that measures nothing counts as connected.
        """
        if not self.sensors or (self.config.on_stale == "error" and self._diagnose()):
            return False
        return self.robot is None or self.robot.is_connected

    def connect(self, calibrate: bool = True) -> None:
        """Open the sensors, wait for a sample of each, and connect the robot.

        Raises:
            DeviceAlreadyConnectedError: It is connected.
            DeviceNotConnectedError: A sensor gives no sample within 10 s.
        """
        if self.sensors:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        self.sensors = self._open(self.config.record)
        try:
            for sensor in self.sensors:
                sensor.wait()
            if self.robot is not None:
                self.robot.connect(calibrate)
        except BaseException:
            self.disconnect()
            raise

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
        """Return the robot's observation, and the newest samples of every sensor.

        Raises:
            DeviceNotConnectedError: It is not connected; or a sensor is stale or has failed, with
                ``on_stale=error``: then all has been disconnected.
        """
        if not self.sensors:
            raise DeviceNotConnectedError(f"{self} is not connected")
        diagnostics = self._diagnose()
        if diagnostics and self.config.on_stale == "error":
            said = DeviceNotConnectedError("; ".join(diagnostics.values()))
            try:
                self.disconnect()  # as LeRobot does after an error, but only of what is connected
            except Exception as error:
                raise said from error
            raise said
        for name in diagnostics.keys() ^ self._diagnosed:
            logging.warning(diagnostics.get(name, f"{name} measures again"))
        self._diagnosed = set(diagnostics)
        found = self.robot.get_observation() if self.robot else {}
        for sensor in self.sensors:
            found.update(zip(sensor.names, sensor.read(), strict=True))
        return found

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action if self.robot is None else self.robot.send_action(action)

    def disconnect(self) -> None:
        """Disconnect the robot, and close the sensors and their recordings."""
        opened, self.sensors = self.sensors, []
        try:
            if self.robot is not None and self.robot.is_connected:
                self.robot.disconnect()
        finally:
            _close(opened)

    def __del__(self) -> None:
        # LeRobot's own asks `is_connected`, and a silent sensor must not leave an arm powered.
        if getattr(self, "sensors", None):
            self.disconnect()

    def _diagnose(self) -> dict[str, str]:
        """Say why, of each sensor that cannot be relied on."""
        return {s.name: diagnostic for s in self.sensors if (diagnostic := s.diagnose())}

    def _open(self, record: str) -> list[Sensor]:
        if record:
            try:
                Path(record).mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"--robot.record: no folder {record}: {error.strerror}") from None
        opened: list[Sensor] = []
        try:
            for name, url in self.config.sensors.items():
                config = self.config
                try:
                    opened.append(Sensor(name, url, config.history, config.max_age_s, record))
                except TactileError as error:
                    raise type(error)(f"--robot.sensors: {name}: {error}") from None
        except BaseException:
            _close(opened)
            raise
        return opened


def _close(sensors: list[Sensor]) -> None:
    with ExitStack() as stack:  # each is closed, whatever another's recording says
        for sensor in sensors:
            stack.callback(sensor.close)
