"""LeRobot itself reads our datasets, and records our sensors.

    python -m venv peer
    peer/bin/pip install -e '.[record,lerobot,view]' -e plugins/lerobot_robot_tactile
    HF_HUB_OFFLINE=1 peer/bin/python -m bench.recording.lerobot_peer

A minute of 35 x 6 at 1 kHz and a film of 30 frames a second become a dataset, which
`LeRobotDataset` loads: every sample is compared with the recording, and every frame with the film.
Then ``lerobot-record`` records a made-up arm with a sensor by the plug-in. LeRobot is gigabytes of
other packages, so no test needs it.
"""

import argparse
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import Robot, RobotConfig
from lerobot.scripts.lerobot_record import DatasetRecordConfig, RecordConfig, record
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.import_utils import register_third_party_plugins

from tactile_rt.evidence.records import Record, show
from tactile_rt.recording import Recording, StreamWriter
from tactile_rt.recording.as_lerobot import read_dataset, write_dataset
from tactile_rt.recording.lerobot_film import film_of
from tactile_rt.sources.opening import open_source
from tactile_rt.stream import concatenate

FPS, SIZE = 30, (64, 96)
TOPICS = ("samples", "decisions", "events", "health")
JOINTS = ("shoulder.pos", "elbow.pos")


@RobotConfig.register_subclass("made_up_arm")
@dataclass(kw_only=True)
class ArmConfig(RobotConfig):
    cameras: dict[str, Any] = field(default_factory=dict)


class Arm(Robot):
    """A robot that is where it was told to be."""

    config_class, name = ArmConfig, "made_up_arm"

    def __init__(self, config: ArmConfig) -> None:
        super().__init__(config)
        self.cameras: dict[str, Any] = {}
        self.action_features = self.observation_features = dict.fromkeys(JOINTS, float)
        self.is_connected, self.is_calibrated = False, True
        self._where = dict.fromkeys(JOINTS, 0.0)

    action_features: Any = None
    observation_features: Any = None
    is_connected: Any = False
    is_calibrated: Any = True

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


@TeleoperatorConfig.register_subclass("made_up_hand")
@dataclass(kw_only=True)
class HandConfig(TeleoperatorConfig):
    pass


class Hand(Teleoperator):
    """Who moves it."""

    config_class, name = HandConfig, "made_up_hand"
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


def write_film(path: Path, frames: int) -> None:
    """Each frame is brighter than the one before, over and over."""
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=FPS, options={"crf": "5"})
        stream.height, stream.width = SIZE
        stream.pix_fmt = "yuv420p"
        for k in range(frames):
            pixels = np.full((*SIZE, 3), brightness(k), np.uint8)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        film.mux(stream.encode())


def brightness(frame: int) -> int:
    return 20 + 10 * (frame % 20)


def datasets(folder: Path, seconds: int) -> list[Record]:
    """A recording and a film as LeRobot sees them."""
    path, film, made = folder / "run.mcap", folder / "front.mp4", folder / "dataset"
    url = f"synthetic:35x6?seconds={seconds}&pace=fast"
    with open_source(url) as source, StreamWriter(path, source, url=url) as writer:
        for chunk in source:
            writer.push(chunk)
    write_film(film, FPS * seconds)
    n = write_dataset([Recording(path)], made, FPS, "touch it", [film_of(f"front={film}")])
    whole = concatenate(list(Recording(path)))
    seen = LeRobotDataset("peer/tactile", root=made, video_backend="pyav")
    found: dict[str, list[Any]] = {name: [] for name in ("seq", "t_ns", "values", "valid")}
    off = 0.0
    for k in range(len(seen)):
        row = seen[k]
        for name, kept in found.items():
            kept.append(row[f"observation.tactile.{name}"][: row["observation.tactile.count"]])
        image = 255 * float(row["observation.images.front"].mean())
        off = max(off, abs(image - brightness(min(k, FPS * seconds - 1))))
    wrong = sum(
        int((np.concatenate([x.numpy() for x in kept]) != getattr(whole, name)).sum())
        for name, kept in found.items()
    )
    _, raws = read_dataset(made)
    back = sorted((raw.topic, raw.t_ns, raw.data) for raw in raws)
    was = sorted((raw.topic, raw.t_ns, raw.data) for raw in Recording(path).raw(*TOPICS))
    how = f"{n} samples, {len(seen)} rows, {seen.meta.total_episodes} episode"
    return [
        Record("recording.lerobot.numbers_that_differ", wrong, "", "== 0", "LeRobotDataset", how),
        Record("recording.lerobot.frames_off", off, "of 255", "<= 4", "", "the frame of each row"),
        Record("recording.lerobot.messages_back", len(set(was) ^ set(back)), "", "== 0", "", how),
    ]


def plugin(folder: Path) -> list[Record]:
    """What ``lerobot-record`` makes of an arm with a sensor."""
    register_third_party_plugins()
    kind = RobotConfig.get_choice_class("tactile")
    sensors = {"finger": "synthetic:1x6"}
    robot = kind(sensors=sensors, robot=ArmConfig(), history=2, record=str(folder / "full"))
    dataset = DatasetRecordConfig(
        repo_id="peer/plugin", single_task="touch it", root=folder / "plugin", fps=FPS,
        episode_time_s=3, reset_time_s=0, num_episodes=1, video=False, push_to_hub=False,
    )  # fmt: skip
    record(RecordConfig(robot=robot, dataset=dataset, teleop=HandConfig(), play_sounds=False))
    seen = LeRobotDataset("peer/plugin", root=folder / "plugin")
    names = seen.features["observation.state"]["names"]
    touched = [k for k, name in enumerate(names) if name.startswith("finger.A0.")]
    states = np.array([seen[k]["observation.state"].numpy() for k in range(len(seen))])
    still = int((np.ptp(states[:, touched], axis=0) == 0).sum())
    (full,) = (folder / "full").glob("finger-*.mcap")
    n = sum(map(len, Recording(full)))
    return [
        Record("recording.lerobot.plugin_rows", len(seen), "rows", ">= 60", "lerobot-record",
               f"names {', '.join([*names[:2], *names[-2:]])}; {n} samples in {full.name}"),
        Record("recording.lerobot.plugin_numbers_still", still, "", "== 0", "", "of the sensor"),
        Record("recording.lerobot.plugin_samples", n, "samples", ">= 2000", "", "at full rate"),
    ]  # fmt: skip


if __name__ == "__main__":
    from rich.console import Console

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60)
    with tempfile.TemporaryDirectory() as name:
        records = datasets(Path(name), parser.parse_args().seconds) + plugin(Path(name))
    show(records, Console())
