"""Footage as pictures and videos: scene, map and traces in one picture for each moment.

The scene is drawn offscreen on a copy of the simulation: nothing here affects the physics.
"""

import copy
import importlib
import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import av
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import ArraySpec
from tactile_rt.sim_backend.views.footage import Camera, Footage, framing
from tactile_rt.sim_backend.views.sheet import ForceScale, Sheet, scene_size
from tactile_rt.sim_backend.world import OBJECT_BIT

OBJECT, HEAD = (0.62, 0.74, 0.82, 1.0), (0.86, 0.81, 0.76, 1.0)
FINE = 2  # drawn finer by this factor, then averaged
GHOST = 0.5  # opacity of whiskers behind objects
# Radii of whiskers (0.02-0.1 mm thick), bases and arrows, relative to the picture's extent
THIN, BASE, SHAFT = 0.0018, 0.006, 0.005
ROOM = 10  # half the side of the surrounding room, relative to extent plus camera distance
MOST_GEOMS = 20_000
DOT, ARROW = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ARROW
IMAGES = (".png", ".jpg")
VIDEOS = (".mp4",)
QUALITY = "20"  # H.264 constant rate factor: 18 is visually lossless, 23 the default

Floats = NDArray[Any]
Pixels = NDArray[np.uint8]


class Dressed:
    """A copy of a simulation's model and state, prepared for drawing.

    Attributes:
        sites: The id of the MuJoCo site at each element's base, in the order of the elements.
    """

    def __init__(self, model: mujoco.MjModel, spec: ArraySpec) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        element = {name: i for i, name in enumerate(spec.elements)}
        self.sites = [self.model.site(name).id for name in spec.elements]
        self.links: list[list[int]] = [[] for _ in spec.elements]
        for geom in range(model.ngeom):
            body = model.geom_bodyid[geom]
            while body and model.body(body).name not in element:
                body = model.body_parentid[body]
            if body:
                self.links[element[model.body(body).name]].append(geom)
        whiskers = [geom for geoms in self.links for geom in geoms]
        self._others = np.setdiff1d(np.arange(model.ngeom), whiskers)
        moved = (model.geom_contype[self._others] & OBJECT_BIT) > 0
        self._objects = self._others[moved]
        self._colours = np.where(moved[:, None], OBJECT, HEAD)
        self._radii = model.geom_size[:, 0].copy()
        self._whiskers = np.array(whiskers)
        self.model.geom_rgba[self._others] = self._colours
        visual = self.model.vis
        visual.headlight.ambient[:] = 0.45
        visual.headlight.diffuse[:] = 0.5
        visual.headlight.specular[:] = 0.0
        visual.quality.numslices, visual.quality.numstacks = 12, 6
        visual.quality.offsamples = 0  # drawing finer gives smooth edges at half the cost

    def points(self) -> NDArray[np.float64]:
        """Compute the (n, 3) ends of all links in the present pose, world, mm."""
        half = self.model.geom_size[self._whiskers, 1, None]
        axes = self.data.geom_xmat[self._whiskers].reshape(-1, 3, 3)[:, :, 2]
        middle = self.data.geom_xpos[self._whiskers]
        return np.concatenate([middle - half * axes, middle + half * axes])

    def object_points(self) -> NDArray[np.float64]:
        """Compute (n, 3) corners of the object's bounding boxes in the world, mm."""
        boxes = self.model.geom_aabb[self._objects].reshape(-1, 2, 3)
        corners = np.array(list(product((-1.0, 1.0), repeat=3)))
        local = boxes[:, 0, None] + corners * boxes[:, 1, None]
        frames = self.data.geom_xmat[self._objects].reshape(-1, 3, 3)
        places = np.einsum("nij,nkj->nki", frames, local) + self.data.geom_xpos[self._objects, None]
        return np.asarray(places.reshape(-1, 3))

    def thicken(self, extent_mm: float) -> None:
        """Draw thin whiskers thick enough to be seen in a picture of this height."""
        radii = self._radii[self._whiskers]
        self.model.geom_size[self._whiskers, 0] = np.hypot(radii, THIN * extent_mm)

    def cover(self, opacity: float) -> None:
        """Set the opacity of everything except whiskers, 0 to 1."""
        self.model.geom_rgba[self._others, 3] = opacity

    def pose(self, footage: Footage, moment: int, scale: ForceScale) -> None:
        """Restore the state of a moment, and colour each whisker by its force."""
        footage.restore(moment, self.data)
        for geoms, size in zip(self.links, scale.per_si * footage.sizes[moment], strict=True):
            self.model.geom_rgba[geoms] = scale.colour(size)


def _add_white_room(scene: mujoco.MjvScene, camera: Camera) -> None:
    """Add a white room around a scene, because MuJoCo's background is black."""
    white, far = np.ones(4, dtype=np.float32), ROOM * (camera.extent_mm + camera.distance_mm)
    for axis in np.eye(3):
        for side in (-far, far):
            place, size = camera.lookat + side * axis, np.where(axis > 0, 1e-3 * far, 1.1 * far)
            _add_geom(scene, mujoco.mjtGeom.mjGEOM_BOX, size, place, white).emission = 1.0


def _add_geom(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: Floats, place: Floats, rgba: Floats
) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size, place, np.eye(3).ravel(), rgba)
    scene.ngeom += 1
    return geom


class Stage:
    """An offscreen renderer of the states in footage; call `close` when done.

    Args:
        width, height: size of the pictures, pixels.
    """

    def __init__(
        self, footage: Footage, camera: Camera, scale: ForceScale, width: int, height: int
    ) -> None:
        self.footage, self.camera, self.scale = footage, camera, scale
        self.dressed = Dressed(footage.model, footage.spec)
        model = self.dressed.model
        self._size = (FINE * width, FINE * height)
        model.vis.global_.offwidth, model.vis.global_.offheight = self._size
        self._view = mujoco.MjvCamera()
        camera.aim(model, self._view)
        self.dressed.thicken(camera.extent_mm)
        self._scene = mujoco.MjvScene(model, MOST_GEOMS)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._gl, self._context = _open_gl(model, *self._size)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def picture(self, moment: int) -> NDArray[np.uint8]:
        """Draw a moment as a (height, width, 3) RGB picture."""
        self.dressed.pose(self.footage, moment, self.scale)
        whole, bare = (self._draw(moment, opacity) for opacity in (1.0, 0.0))
        # An object that hides whiskers looks like glass, as a whole instead of piece by piece.
        return np.asarray(Image.blend(whole, bare, GHOST).reduce(FINE))

    def _draw(self, moment: int, opacity: float) -> Image.Image:
        model, data, scene = self.dressed.model, self.dressed.data, self._scene
        self.dressed.cover(opacity)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, self._view, everything, scene)
        self._add_forces(moment)
        _add_white_room(scene, self.camera)
        pixels = np.empty((self._size[1], self._size[0], 3), dtype=np.uint8)
        area = mujoco.MjrRect(0, 0, *self._size)
        self._gl.make_current()
        mujoco.mjr_render(area, scene, self._context)
        mujoco.mjr_readPixels(pixels, None, area, self._context)
        return Image.fromarray(pixels[::-1])

    def _add_forces(self, moment: int) -> None:
        """Add a dot for each element, and an arrow in the direction of its force."""
        data, scale, extent_mm = self.dressed.data, self.scale, self.camera.extent_mm
        sizes = (scale.per_si * self.footage.sizes[moment]).tolist()
        loads = self.footage.loads[moment]
        for site, size, load in zip(self.dressed.sites, sizes, loads, strict=True):
            base = data.site_xpos[site]
            force = data.site_xmat[site].reshape(3, 3) @ load[:3]
            rgba = np.array(scale.colour(size), dtype=np.float32)
            _add_geom(self._scene, DOT, np.full(3, BASE * extent_mm), base, rgba)
            if scale.draws(size):
                arrow = _add_geom(self._scene, ARROW, np.ones(3), base, rgba)
                end = base + force / max(np.linalg.norm(force), 1e-12) * scale.length(size)
                mujoco.mjv_connector(arrow, ARROW, SHAFT * extent_mm, base, end)
                arrow.size[2] *= 2  # MuJoCo draws an arrow half as long as it connects

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


def _open_gl(model: mujoco.MjModel, width: int, height: int) -> tuple[Any, mujoco.MjrContext]:
    """Open an OpenGL and a MuJoCo context, by MUJOCO_GL or the first backend that works.

    mujoco.Renderer is not used, because it chooses the backend too early: at mujoco's first import.
    """
    choice = os.environ.get("MUJOCO_GL", "").lower().strip()
    if choice in ("egl", "osmesa", "glfw", "cgl"):
        kinds = [choice]
    elif sys.platform == "linux":
        screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        kinds = ["egl", "glfw"] if screen else ["egl"]
    else:
        kinds = ["cgl", "glfw"] if sys.platform == "darwin" else ["glfw"]
    failures = []
    for kind in kinds:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # from GLFW, which fails later, when it is used
                context = importlib.import_module(f"mujoco.{kind}").GLContext(width, height)
                context.make_current()
            return context, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each driver fails in its own way
            failures.append(f"{kind}: {error or type(error).__name__}")
    why = "; ".join(failures).replace("\n", " ")
    raise ConfigError(
        f"no OpenGL to draw with ({why}): install libegl1 and libgl1-mesa-dri, or set MUJOCO_GL"
    )


def camera_of(footage: Footage, view: str, aspect: float = 1.5) -> Camera:
    """Fit a named view to the resting whiskers and the object at its strongest touch."""
    dressed = Dressed(footage.model, footage.spec)
    footage.restore(0, dressed.data)
    left = all(x < 0 for x, _, _ in footage.spec.positions)
    whiskers = dressed.points()
    footage.restore(footage.strongest, dressed.data)
    points = np.concatenate([whiskers, dressed.object_points()])
    return framing(view, points, aspect, left)


class Film:
    """A renderer of complete pictures of footage; call `close` when done.

    Args:
        pixels: width of the pictures; their height is 9/16 of the width.

    Raises:
        ConfigError: no such view, or this machine has no OpenGL to draw with.
    """

    def __init__(
        self,
        footage: Footage,
        view: str = "oblique",
        title: str = "",
        detail: str = "",
        pixels: int = 1280,
    ) -> None:
        self.footage = footage
        width, height = scene_size(pixels)
        camera = camera_of(footage, view, width / height)
        scale = ForceScale.fitting(footage.sizes, camera.extent_mm, footage.spec.units[0])
        self._stage = Stage(footage, camera, scale, width, height)
        self._sheet = Sheet(footage, camera, scale, title, detail, pixels)
        self.size = self._sheet.size

    def picture(self, moment: int) -> Pixels:
        """Draw a moment of the footage as a (height, width, 3) RGB picture."""
        return self._sheet.picture(moment, self._stage.picture(moment))

    def __iter__(self) -> Iterator[Pixels]:
        return map(self.picture, range(len(self.footage)))

    def close(self) -> None:
        """Free the OpenGL context."""
        self._stage.close()


def check_suffix(path: Path) -> str:
    """Return a file's suffix; raise a `ConfigError` unless in `IMAGES` or `VIDEOS`."""
    suffix = path.suffix.lower()
    if suffix not in IMAGES + VIDEOS:
        raise ConfigError(
            f"{path}: give a name that ends in {', '.join(IMAGES)} for a picture, "
            f"or {', '.join(VIDEOS)} for a video"
        )
    return suffix


def write_image(path: Path, pixels: Pixels) -> None:
    """Write a picture (height, width, 3) RGB as .png or .jpg."""
    kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
    write_whole(path, lambda file: Image.fromarray(pixels).save(file, kind, optimize=True))


def write_video(path: Path, pictures: Iterable[Pixels], fps: int) -> None:
    """Write pictures (height, width, 3) RGB of one even size as .mp4 (H.264)."""
    write_whole(path, lambda file: _write_mp4(file, pictures, fps))


def _write_mp4(out: BinaryIO, pictures: Iterable[Pixels], fps: int) -> None:
    # opened by name, because faststart moves the index to the front at the end
    with av.open(str(out.name), "w", "mp4", options={"movflags": "+faststart"}) as file:
        stream = file.add_stream("libx264", rate=fps, options={"crf": QUALITY})
        stream.pix_fmt = "yuv420p"  # supported by every player
        for k, pixels in enumerate(pictures):
            if k == 0:
                stream.height, stream.width = pixels.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            file.mux(stream.encode(picture))
        file.mux(stream.encode())
