"""Work that goes wrong, for the engines to survive: it is imported by the processes they start."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from tactile_rt.core.errors import ConfigError


@dataclass(frozen=True)
class FrailWork:
    """Does what the name says, and notes every try in a file of that name."""

    folder: Path

    def __call__(self, name: str) -> str | None:
        with (self.folder / name).open("a") as file:
            file.write(f"{os.getpid()}\n")
        tries = len((self.folder / name).read_text().split())
        match name.split("-"):
            case "dies", times if tries <= int(times):
                os.kill(os.getpid(), signal.SIGKILL)
            case "refuses", _:
                raise ConfigError(f"{name} cannot be")
            case "skips", why:
                return why
            case "sleeps", seconds:
                time.sleep(float(seconds))
        return None
