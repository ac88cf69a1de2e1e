"""Draw docs/pictures/house.svg: the rooms of the package on their floors, and who imports whom.

    python -m bench.pictures.house            # redraws it
    python -m bench.pictures.house --check    # leaves with 1 where the picture is not of this tree

Floors are those that the linter of imports holds us to, arrows the imports that there are. An
arrow is left out where others lead to the same room, so that what is left can be followed.
"""

import argparse
import sys
import tomllib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docs" / "pictures" / "house.svg"
PACKAGE = "tactile_rt"
WIDTH, FLOOR, ROOM, GAP, LETTER = 1180, 96, 34, 18, 7.6  # in the picture's units
MARGIN = 26
HEAVY = "the robot's path never reaches"  # the contract whose rooms are the robot's
STYLE = """
text { font: 13px ui-monospace, 'DejaVu Sans Mono', monospace; text-anchor: middle; fill: #17242b }
.note { font: 12px sans-serif; text-anchor: start; fill: #50636d }
.robot { fill: #cfe6dc; stroke: #2f7d5f }
.desk { fill: #e6e1f2; stroke: #6b5b95 }
.floor { stroke: #d5dde1; stroke-dasharray: 2 5 }
.arrow { fill: none; stroke: #50636d; stroke-opacity: .75; stroke-width: 1.3 }
.faint { fill: none; stroke: #50636d; stroke-opacity: .28; stroke-width: 1 }
"""


def floors() -> tuple[tuple[str, ...], ...]:
    """The rooms of each floor, the highest first, as pyproject.toml has them."""
    layers = next(c for c in contracts() if c["type"] == "layers")["layers"]
    return tuple(tuple(room.strip() for room in layer.split("|")) for layer in layers)


def robot(arrows: Mapping[str, set[str]]) -> set[str]:
    """The rooms that never reach what a robot has not, and all that they import."""
    contract = next(c for c in contracts() if c["name"].startswith(HEAVY))
    waiting, found = [name.partition(".")[2] for name in contract["source_modules"]], set()
    while waiting:
        found.add(room := waiting.pop())
        waiting += arrows[room] - found
    return found


def contracts() -> list[dict]:
    """What the linter of imports is told."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    found: list[dict] = project["tool"]["importlinter"]["contracts"]
    return found


def imports() -> dict[str, set[str]]:
    """By room, the other rooms that it imports when it runs."""
    graph = grimp.build_graph(PACKAGE, exclude_type_checking_imports=True, cache_dir=None)
    found: dict[str, set[str]] = defaultdict(set)
    for module in graph.modules:
        room = room_of(module)
        for imported in graph.find_modules_directly_imported_by(module):
            if room and (other := room_of(imported)) and other != room:
                found[room].add(other)
    return {room: set(found[room]) for floor in floors() for room in floor}


def room_of(module: str) -> str:
    """The folder or file directly under the package; empty for the face."""
    return module.partition(".")[2].partition(".")[0]


def reduced(arrows: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """The arrows that no other way replaces; `arrows` have no circle."""
    reach: dict[str, set[str]] = {}

    def below(room: str) -> set[str]:
        if room not in reach:
            reach[room] = arrows[room].union(*map(below, arrows[room]))
        return reach[room]

    return {
        room: {a for a in there if not any(a in below(b) for b in there)}
        for room, there in arrows.items()
    }


def draw() -> str:
    """The picture, as SVG."""
    every = imports()
    arrows, light = reduced(every), robot(every)
    place, ground = places(arrows), set(floors()[-1])
    height = MARGIN * 2 + FLOOR * len(floors())
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}">',
        f"<style>{STYLE}</style>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7"'
        ' markerHeight="7" orient="auto"><path d="M0 0 8 4 0 8z" fill="#50636d"/></marker></defs>',
        f'<rect width="{WIDTH}" height="{height}" fill="#fbfcfc"/>',
    ]
    for room, there in arrows.items():
        x, y = place[room]
        for other in sorted(there):
            u, v = place[other]
            bend, kind = (v - y) * 0.45, "faint" if other in ground else "arrow"
            parts.append(
                f'<path class="{kind}" marker-end="url(#tip)" d="M{x:.0f} {y + ROOM / 2:.0f}'
                f' C{x:.0f} {y + bend:.0f} {u:.0f} {v - bend:.0f} {u:.0f} {v - ROOM / 2 - 2:.0f}"/>'
            )
    for room, (x, y) in place.items():
        wide, kind = breadth(room), "robot" if room in light else "desk"
        parts.append(
            f'<rect class="{kind}" x="{x - wide / 2:.0f}" y="{y - ROOM / 2:.0f}" rx="5"'
            f' width="{wide:.0f}" height="{ROOM}"/><text x="{x:.0f}" y="{y + 4:.0f}">{room}</text>'
        )
    for line, kind in enumerate(("robot", "desk")):
        said = ("needs neither torch nor MuJoCo", "may need them, where asked to")
        y = MARGIN + 18 * line
        parts.append(
            f'<rect class="{kind}" x="{MARGIN}" y="{y}" width="12" height="12" rx="2"/>'
            f'<text class="note" x="{MARGIN + 18}" y="{y + 10}">{said[line]}</text>'
        )
    return "\n".join([*parts, "</svg>\n"])


def breadth(room: str) -> float:
    return LETTER * len(room) + 20


def places(arrows: Mapping[str, set[str]]) -> dict[str, tuple[float, float]]:
    """Where each room's middle is: on its floor, near what it imports and what imports it."""
    place: dict[str, tuple[float, float]] = {}
    near = {room: set(there) for room, there in arrows.items()}
    for room, there in arrows.items():
        for other in there:
            near[other].add(room)
    for turn in range(24):  # each floor in turn is put in the order of its neighbours' middles
        for level, rooms in enumerate(floors()):
            order = sorted(rooms, key=lambda room: (_middle(near[room], place, turn), room))
            free = WIDTH - 2 * MARGIN - sum(map(breadth, rooms)) - GAP * (len(rooms) - 1)
            x = MARGIN + free / 2
            spread = min(free / (len(rooms) + 1), 190.0)
            x -= spread * (len(rooms) - 1) / 2
            for room in order:
                x += breadth(room) / 2
                place[room] = (x, MARGIN + FLOOR * (level + 0.5))
                x += breadth(room) / 2 + GAP + spread
    return place


def _middle(rooms: set[str], place: Mapping[str, tuple[float, float]], turn: int) -> float:
    known = [place[room][0] for room in rooms if room in place]
    return sum(known) / len(known) if known else WIDTH / 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    if not parser.parse_args().check:
        FILE.write_text(draw(), "utf-8")
    elif FILE.read_text("utf-8") != draw():
        sys.exit(f"{FILE} is not of this tree: python -m bench.pictures.house redraws it")


if __name__ == "__main__":
    main()
