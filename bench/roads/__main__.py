import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from bench.roads.base import walk_base
from bench.roads.extras import EXTRAS, walk_extra
from bench.roads.lerobot import RELEASES, walk_lerobot
from bench.roads.page import walk_page
from bench.roads.walking import Failed, Road, build_wheel, find_python, new_road

Walk = Callable[[Road, Path], None]
PYTHONS = ("3.11", "3.12", "3.13")


def walk(name: str, python: str, installer: str, wheel: Path, road: Walk) -> bool:
    """Walk one road; says whether it came to its end."""
    found = find_python(python)
    title = f"{name}, Python {python}, {installer}"
    if not found:
        sys.stdout.write(f"{title}: NOT WALKED, this Python is not here\n")
        return False
    try:
        with new_road(title, found, installer) as made:
            road(made, wheel)
            made.tell("walked to its end")
    except Failed as error:
        sys.stdout.write(f"{title}: FAILED at {error}\n")
        return False
    return True


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.roads")
    parser.add_argument("roads", nargs="*", default=["base", "page", "extras"])
    parser.add_argument("--pythons", default=",".join(PYTHONS))
    parser.add_argument("--installers", default="pip,uv")
    parser.add_argument("--extras", default=",".join(EXTRAS))
    asked = parser.parse_args()
    pythons, installers = asked.pythons.split(","), asked.installers.split(",")
    walked: dict[str, bool] = {}

    def go(name: str, python: str, installer: str, road: Walk) -> None:
        walked[f"{name} {python} {installer}"] = walk(name, python, installer, wheel, road)

    with tempfile.TemporaryDirectory() as folder:
        wheel = build_wheel(Path(folder))
        for name in asked.roads:
            if name in ("base", "page"):
                for python in pythons:
                    for installer in installers:
                        go(name, python, installer, walk_base if name == "base" else walk_page)
            elif name == "extras":
                for extra in asked.extras.split(","):

                    def of_extra(road: Road, wheel: Path, extra: str = extra) -> None:
                        walk_extra(road, wheel, extra)

                    go(f"extra {extra}", pythons[0], installers[0], of_extra)
            elif name == "lerobot":
                for python in pythons:
                    go(f"lerobot {RELEASES[python]}", python, "uv", walk_lerobot)
            else:
                parser.error(f"no road {name!r}: there are base, page, extras, lerobot")
    ended = [name for name, whole in walked.items() if not whole]
    sys.stdout.write(f"{len(walked) - len(ended)} of {len(walked)} roads walked to their end\n")
    sys.stdout.write("".join(f"  not: {name}\n" for name in ended))
    return 1 if ended else 0


if __name__ == "__main__":
    sys.exit(main())
