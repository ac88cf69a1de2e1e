"""LeRobot itself reads our datasets; `bench.roads` records with its command line.

    python -m venv peer
    peer/bin/pip install -e '.[lerobot]' lerobot
    HF_HUB_OFFLINE=1 peer/bin/python -m bench.recording.lerobot_peer

A minute of 35 x 6 at 1 kHz and a film of 30 frames a second become a dataset, which
`LeRobotDataset` loads: every sample is compared with the recording, and every frame with the film.
LeRobot is gigabytes of other packages, so no test needs it.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import av
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from tactile_rt.core.stream import concatenate
from tactile_rt.models.evaluation.records import Record, show
from tactile_rt.recording import Recording, StreamWriter
from tactile_rt.recording.as_lerobot import write_dataset
from tactile_rt.recording.lerobot_meta import film_of
from tactile_rt.sources.opening import open_source

FPS, SIZE = 30, (64, 96)


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
    how = f"{n} samples, {len(seen)} rows, {seen.meta.total_episodes} episode"
    return [
        Record("recording.lerobot.numbers_that_differ", wrong, "", "== 0", "LeRobotDataset", how),
        Record("recording.lerobot.frames_off", off, "of 255", "<= 4", "", "the frame of each row"),
    ]


if __name__ == "__main__":
    from rich.console import Console

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60)
    with tempfile.TemporaryDirectory() as name:
        records = datasets(Path(name), parser.parse_args().seconds)
    show(records, Console())
