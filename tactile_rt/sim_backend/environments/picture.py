"""A picture of a whisking head beside its object, from above and from the side."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tactile_rt.sim_backend.environments.whisking_head import WhiskingHead
from tactile_rt.sim_backend.rods.chains import Pose, place

__all__ = ["picture", "whisker_nodes"]

Floats = NDArray[np.float64]

SIDE, MARGIN_MM = 320, 25.0
PAPER, THING, EDGE = (255, 255, 255), (214, 186, 140), (170, 130, 80)
WHISKER, TOUCHING = (60, 60, 70), (200, 40, 40)
VIEWS = ((0, 1), (1, 2))  # from above: x to the right, y up; from the side: y to the right, z up


def whisker_nodes(head: WhiskingHead) -> list[Floats]:
    """(node, 3) of every whisker now, base to tip, in the frame of the head's start, mm."""
    frames = head.frames(np.array([head.samples]))[0]
    nodes, at = [], 0
    for whisker, rod, frame in zip(head.array.whiskers, head.world.rods, frames, strict=True):
        chain = rod.chain
        links, joints = len(chain.length), len(chain.stiffness)
        pose = Pose(np.empty((links + 1, 3)), np.empty((links, 3, 3)), np.empty((joints, 3)))
        mount = head.array.mount
        pose.nodes[0] = mount.rotation @ np.array(whisker.base) + mount.position
        pose.frames[0] = frame @ rod.to_element.T
        place(chain, head.world.angles[at : at + joints], pose)
        nodes.append(pose.nodes + head.position)
        at += joints
    return nodes


def picture(head: WhiskingHead) -> NDArray[np.uint8]:
    """(320, 640, 3) the array, red where whiskers touch, and the object.

    Raises:
        ModuleNotFoundError: without Pillow (extra ``view``).
    """
    from PIL import Image, ImageDraw

    placed = head.placed
    corners = [piece.corners + placed.centre for piece in placed.pieces]
    everything = np.concatenate([*corners, placed.low[None], placed.high[None]])
    image = Image.new("RGB", (len(VIEWS) * SIDE, SIDE), PAPER)
    draw = ImageDraw.Draw(image)
    touching = head.touching
    for panel, axes in enumerate(VIEWS):
        low, high = everything[:, axes].min(axis=0), everything[:, axes].max(axis=0)
        middle, span = (low + high) / 2, (high - low).max() + MARGIN_MM

        def seen(
            points: Floats,
            axes: tuple[int, int] = axes,
            middle: Floats = middle,
            span: float = span,
            panel: int = panel,
        ) -> list[tuple[float, float]]:
            at = (points[:, axes] - middle) * (SIDE / span)
            return [(panel * SIDE + SIDE / 2 + u, SIDE / 2 - v) for u, v in at]

        for points in corners:
            outline = points[ConvexHull(points[:, axes]).vertices]
            draw.polygon(seen(outline), fill=THING, outline=EDGE)
        for line, touches in zip(whisker_nodes(head), touching, strict=True):
            draw.line(seen(line), fill=TOUCHING if touches else WHISKER, width=2)
    return np.asarray(image, dtype=np.uint8)
