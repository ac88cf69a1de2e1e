"""The plug-in under LeRobot's own parser: every command starts, and touch that is dead is no touch.

draccus is LeRobot's parser. LeRobot itself is gigabytes: it stands here as the four names that the
plug-in takes of it; `bench/roads/lerobot.py` goes through its own command line.
"""

import queue
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import Chunk, EndOfStream, Source
from tactile_rt.recording import Recording
from tactile_rt.testing import FakeSerial, small_spec
from tests.helpers.waiting import until

draccus = pytest.importorskip("draccus")
PLUGIN = Path(__file__).parents[2] / "plugins" / "lerobot_robot_tactile"
SPEC = small_spec()  # 3 elements at 1 kHz
FX = [f"finger.{element}.{SPEC.channels[0]}" for element in SPEC.elements]


@pytest.fixture
def lerobot(monkeypatch):
    """LeRobot's base classes, with one type of robot, and the plug-in installed."""
    names = ("", ".robots", ".robots.config", ".utils", ".utils.errors")
    package = {name: ModuleType(f"lerobot{name}") for name in names}

    @dataclass(kw_only=True)
    class RobotConfig(draccus.ChoiceRegistry):
        id: str | None = None
        calibration_dir: Path | None = None

        def __post_init__(self) -> None: ...

    class Robot:
        def __init__(self, config: RobotConfig) -> None:
            self.id = config.id

    @RobotConfig.register_subclass("made_up_arm")
    @dataclass(kw_only=True)
    class ArmConfig(RobotConfig):
        port: str = "/dev/null"
        cameras: dict[str, str] = field(default_factory=dict)

    class Arm(Robot):
        is_connected = False
        action_features = observation_features = {"elbow.pos": float}  # noqa: RUF012

        def connect(self, calibrate: bool) -> None:
            self.is_connected = True

        def disconnect(self) -> None:
            self.is_connected = False

        def get_observation(self) -> dict[str, Any]:
            return {"elbow.pos": 0.25}

    package[".robots"].Robot, package[".robots.config"].RobotConfig = Robot, RobotConfig
    package[".robots"].make_robot_from_config = Arm
    for name in ("DeviceAlreadyConnectedError", "DeviceNotConnectedError"):
        setattr(package[".utils.errors"], name, type(name, (ConnectionError,), {}))
    for name, module in package.items():
        monkeypatch.setitem(sys.modules, f"lerobot{name}", module)
    monkeypatch.syspath_prepend(PLUGIN)
    for name in ("", ".config_tactile", ".tactile"):
        monkeypatch.delitem(sys.modules, f"lerobot_robot_tactile{name}", raising=False)
    import lerobot_robot_tactile

    return lerobot_robot_tactile


@pytest.fixture
def read_arguments(lerobot):
    """What a LeRobot command makes of its arguments: the robot's configuration."""
    from lerobot.robots.config import RobotConfig

    @dataclass
    class RecordConfig:
        robot: RobotConfig
        fps: int = 30

    return lambda *arguments: draccus.parse(RecordConfig, args=list(arguments)).robot


class Plugged(Source):
    """A sensor of which a test says when it gives a sample."""

    def __init__(self) -> None:
        super().__init__(SPEC)
        self.chunks: queue.Queue[Chunk | Exception] = queue.Queue()
        self.sent = 0

    def give(self, value: float, valid: tuple[bool, ...] = (True,) * 3) -> None:
        values = np.full((1, *SPEC.shape), value, np.float32)
        now = np.array([time.monotonic_ns()])
        self.chunks.put(Chunk(np.array([self.sent]), now, values, np.array([valid])))
        self.sent += 1

    def read(self, timeout: float | None = None) -> Chunk | None:
        try:
            found = self.chunks.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(found, Exception):
            raise found
        return found

    def close(self) -> None: ...


@pytest.fixture
def touch(lerobot, monkeypatch, read_arguments):
    """Make a robot of some arguments and its sensor, connected; disconnected at the end."""
    made = []

    def make(*arguments):
        sensor = Plugged()
        monkeypatch.setattr(lerobot.tactile, "open_source", lambda url: sensor)
        sensors = ("--robot.type=tactile", "--robot.sensors={finger: 'any:'}")
        robot = lerobot.Tactile(read_arguments(*sensors, *arguments))
        made.append(robot)
        sensor.give(1.0)
        robot.connect()
        return robot, sensor

    yield make
    for robot in made:
        robot.disconnect()


def seen(robot, name):
    return robot.get_observation()[name]


def error_of(robot):
    """The message with which an observation is refused; empty if it is given."""
    from lerobot.utils.errors import DeviceNotConnectedError

    try:
        robot.get_observation()
    except DeviceNotConnectedError as error:
        return str(error)
    return ""


def test_a_command_of_another_robot_starts_with_the_plug_in_installed(read_arguments):
    robot = read_arguments("--robot.type=made_up_arm", "--robot.port=/dev/ttyACM0")
    assert robot.port == "/dev/ttyACM0"


def test_the_help_of_a_command_ends(read_arguments, capsys):
    with pytest.raises(SystemExit) as left:
        read_arguments("--help")
    assert left.value.code == 0
    assert "--robot.sensors" in capsys.readouterr().out


def test_the_robot_that_carries_the_sensors_is_read_from_its_braces(read_arguments):
    robot = read_arguments(
        "--robot.type=tactile",
        "--robot.robot={type: made_up_arm, port: /dev/ttyACM1, cameras: {a: b}}",
        "--robot.sensors={finger: 'serial:///dev/ttyACM0?codec=native'}",
        "--robot.history=2",
    )
    assert robot.sensors == {"finger": "serial:///dev/ttyACM0?codec=native"}
    assert (robot.robot.port, robot.cameras, robot.history) == ("/dev/ttyACM1", {"a": "b"}, 2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "names no sensor"),
        (["--robot.sensors={f: 'x:'}", "--robot.robot={port: /dev/null}"], "names no type"),
        (["--robot.sensors={f: 'x:'}", "--robot.robot={type: tactile}"], "'tactile' is no type"),
        (["--robot.sensors={f: 'x:'}", "--robot.on_stale=wait"], "must be error or nan"),
        (["--robot.sensors={f: 'x:'}", "--robot.history=101"], "must be 1 to 100, not 101"),
        (["--robot.sensors={../f: 'x:'}"], "'../f' is no name"),
        (["--robot.sensors={f:replay:demo}"], "'f:replay:demo' is no name"),
    ],
)
def test_a_mistake_is_said(read_arguments, arguments, said):
    with pytest.raises(draccus.utils.ParsingError) as raised:
        read_arguments("--robot.type=tactile", *arguments)
    assert said in str(raised.value.__cause__)


def test_the_robot_is_named_by_its_type_and_has_the_name_that_is_given(read_arguments):
    sensors = "--robot.sensors={finger: 'any:'}"
    arm = "--robot.robot={type: made_up_arm, id: right}"
    for robot, name in (("--robot.robot=made_up_arm", "left"), (arm, "right")):
        read = read_arguments("--robot.type=tactile", "--robot.id=left", sensors, robot)
        assert (read.id, read.robot.id, read.robot.port) == ("left", name, "/dev/null")


def test_an_observation_is_the_robot_s_and_the_newest_samples(touch):
    robot, sensor = touch("--robot.robot={type: made_up_arm}", "--robot.max_age_s=60")
    sensor.give(2.0)
    until(lambda: seen(robot, FX[0]) == 2.0)
    found = robot.get_observation()
    assert found["elbow.pos"] == 0.25 and found["finger.valid"] == 1.0
    assert 0 <= found["finger.age_ms"] < 60_000
    assert list(found) == list(robot.observation_features)


def test_the_age_limit_is_three_periods_and_at_least_a_tenth_of_a_second(lerobot, monkeypatch):
    for rate_hz, limit in ((1000.0, 0.1), (10.0, 0.3)):
        source = Plugged()
        source.spec = small_spec(rate_hz=rate_hz)
        monkeypatch.setattr(lerobot.tactile, "open_source", lambda url, source=source: source)
        sensor = lerobot.tactile.Sensor("finger", "any:")
        sensor.close()
        assert sensor.max_age_s == pytest.approx(limit)


def test_a_sensor_that_stands_still_is_an_error_and_the_arm_is_released(touch):
    robot, _ = touch("--robot.robot={type: made_up_arm}")
    arm = robot.robot
    until(lambda: not robot.is_connected)
    assert arm.is_connected
    assert "finger has given no valid sample for" in error_of(robot)
    assert not arm.is_connected
    assert "is not connected" in error_of(robot)


def test_a_stream_that_is_over_is_an_error_at_once(touch):
    robot, sensor = touch("--robot.max_age_s=3600")
    sensor.chunks.put(EndOfStream())
    until(lambda: not robot.is_connected)
    assert error_of(robot) == "finger: its stream is over"


def test_by_choice_what_a_silent_sensor_measures_is_nan_until_it_comes_back(touch):
    robot, sensor = touch("--robot.on_stale=nan", "--robot.max_age_s=0.5")
    until(lambda: np.isnan(seen(robot, FX[0])))
    assert robot.is_connected
    assert seen(robot, "finger.valid") == 0.0 and seen(robot, "finger.age_ms") > 500
    back = {(FX[0], 3.0), ("finger.valid", 1.0)}
    until(lambda: back <= robot.get_observation().items(), meanwhile=lambda: sensor.give(3.0))


def test_an_element_that_goes_away_is_nan_and_the_others_go_on(touch):
    robot, sensor = touch("--robot.on_stale=nan", "--robot.max_age_s=0.5")

    def gone():
        first, away, last, valid = map(robot.get_observation().get, (*FX, "finger.valid"))
        return first == last == 4.0 and valid == pytest.approx(2 / 3) and np.isnan(away)

    until(gone, meanwhile=lambda: sensor.give(4.0, (True, False, True)))


def test_history_keeps_the_samples_in_their_order(touch):
    robot, sensor = touch("--robot.history=3", "--robot.max_age_s=60")
    for value in (2.0, 3.0, 4.0):
        sensor.give(value)
    until(lambda: seen(robot, f"{FX[0]}.0") == 4.0)
    assert [seen(robot, f"{FX[0]}.{ago}") for ago in (2, 1, 0)] == [2.0, 3.0, 4.0]


def test_a_sensor_that_never_speaks_does_not_connect(lerobot, touch, monkeypatch):
    from lerobot.utils.errors import DeviceNotConnectedError

    monkeypatch.setattr(lerobot.tactile, "FIRST_S", 0.01)
    monkeypatch.setattr(Plugged, "give", lambda self, value: None)
    with pytest.raises(DeviceNotConnectedError, match="finger gave no sample within"):
        touch()


def test_of_a_sensor_that_dies_the_recording_is_whole(touch, tmp_path):
    robot, _ = touch(f"--robot.record={tmp_path}")
    until(lambda: error_of(robot))
    (path,) = tmp_path.glob("finger-*.mcap")
    assert sum(map(len, Recording(path))) == 1


@pytest.mark.parametrize("stale", ["error", "nan"])
def test_a_recording_that_fails_is_said_and_hides_no_touch(touch, tmp_path, caplog, stale):
    words = (f"--robot.record={tmp_path}", f"--robot.on_stale={stale}")
    robot, sensor = touch(*words, "--robot.max_age_s=60")

    def full(chunk):
        raise RecordingError("no space left")

    robot.sensors[0]._writer.push = full
    sensor.give(5.0)
    if stale == "error":
        until(lambda: "finger is not recorded: no space left" in error_of(robot))
        return
    until(lambda: seen(robot, FX[0]) == 5.0)
    until(lambda: seen(robot, FX[0]) == 5.0 and caplog.messages)
    assert caplog.messages == ["finger is not recorded: no space left"]


def test_every_sensor_is_closed_whatever_the_recording_of_one_says(lerobot, monkeypatch):
    closed = []

    class Failing(Plugged):
        def close(self) -> None:
            closed.append(self)
            raise RecordingError("no space left")

    sensors = [Failing() for _ in range(3)]
    left = iter(sensors)
    monkeypatch.setattr(lerobot.tactile, "open_source", lambda url: next(left))
    names = dict.fromkeys(("a", "b", "c"), "any:")
    robot = lerobot.Tactile(lerobot.TactileConfig(sensors=names))
    for sensor in sensors:
        sensor.give(1.0)
    robot.connect()
    with pytest.raises(RecordingError):
        robot.disconnect()
    assert set(closed) == set(sensors)


def test_a_wrong_url_is_told_with_its_sensor(lerobot):
    robot = lerobot.Tactile(lerobot.TactileConfig(sensors={"right": "replay:nope.mcap"}))
    with pytest.raises(ConfigError, match=r"--robot.sensors: right: no file nope.mcap"):
        robot.connect()


def test_what_goes_on_with_nan_is_logged_once_each_way(touch, caplog):
    robot, sensor = touch("--robot.on_stale=nan", "--robot.max_age_s=0.3")
    until(lambda: np.isnan(seen(robot, FX[0])))
    until(lambda: seen(robot, FX[0]) == 3.0, meanwhile=lambda: sensor.give(3.0))
    until(lambda: seen(robot, FX[0]) and len(caplog.messages) > 1, meanwhile=lambda: sensor.give(3))
    assert "finger has given no valid sample" in caplog.messages[0]
    assert caplog.messages[1] == "finger measures again"


def test_a_device_that_is_pulled_out_is_no_touch(lerobot, read_arguments):
    with FakeSerial(np.ones((1, *SPEC.shape)), spec=SPEC) as device:
        sensor = f"--robot.sensors={{finger: '{device.url}'}}"
        robot = lerobot.Tactile(read_arguments("--robot.type=tactile", sensor))
        robot.connect()
        try:
            device.unplug()
            until(lambda: error_of(robot))
        finally:
            robot.disconnect()
