"""Trains in a process of its own, for `test_training`: SET RUN killed|OBJECTIVE."""

import hashlib
import json
import os
import signal
import sys
from pathlib import Path

import lightning.fabric  # noqa: F401  before the forks, or each of them spends seconds on it
import torch

from tactile_rt.models.training import loop
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import train

SMALL = {"encoder": "gru", "decoder": "linear", "width": 1 / 32, "batch": 6}


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def killed(data: str, folder: Path) -> None:
    config = TrainingConfig(data, **SMALL, epochs=4, dropout=0.2, attender="gpt")
    save, log = loop.save_whole, loop.log_epoch

    def at_update(number):
        return lambda p: die() if p.update == number and not p.metrics else None

    def before_saving(name):
        def guarded(path, state):
            if path.name == name and state.get("epoch", 2) == 2:
                die()
            save(path, state)

        return guarded

    def after_logging(path, metrics):
        log(path, metrics)
        if metrics["epoch"] == 3:
            die()

    moments = (
        {"report": at_update(3)},  # the middle of the second epoch
        {"save": before_saving("last.pt")},  # the second epoch's best.pt and history are there
        {"log": after_logging},
        {"report": at_update(8)},
    )
    deaths = []
    for moment in moments:
        child = os.fork()
        if not child:
            loop.save_whole = moment.get("save", save)
            loop.log_epoch = moment.get("log", log)
            train(config, folder, moment.get("report", lambda _: None))
            os._exit(0)
        deaths.append(-os.WTERMSIG(os.waitpid(child, 0)[1]))
    train(config, folder)
    print(json.dumps({"deaths": deaths}))  # noqa: T201


def shared(data: str, folder: Path, objective: str) -> None:
    config = TrainingConfig(
        data, **SMALL, objective=objective, dropout=0.0, updates=3, precision="fp32"
    )
    made, build = [], loop.build_objective

    def keep(*arguments):
        made.append(build(*arguments))
        return made[-1]

    loop.build_objective = keep
    train(config, folder)
    state = made[0].state_dict()
    found = hashlib.sha256(b"".join(t.numpy().tobytes() for t in state.values())).hexdigest()
    assert not torch.distributed.is_initialized()
    devices = int(os.environ["WORLD_SIZE"])
    sys.stdout.write(json.dumps({"digest": found, "devices": devices}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    data, folder, what = sys.argv[1], Path(sys.argv[2]), sys.argv[3]
    if what == "killed":
        killed(data, folder)
    else:
        shared(data, folder, what)
