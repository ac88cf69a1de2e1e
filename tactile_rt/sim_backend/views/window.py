"""Footage in MuJoCo's interactive viewer: turn it, zoom, stop the time."""

import time
import warnings

import mujoco

from tactile_rt.errors import ConfigError
from tactile_rt.sim_backend.views.camera import Camera
from tactile_rt.sim_backend.views.footage import Footage
from tactile_rt.sim_backend.views.scale import ForceScale
from tactile_rt.sim_backend.views.stage import Dressed, add_forces, add_paper, has_display

__all__ = ["check_display", "show"]

SPACE, LEFT, RIGHT = 32, 263, 262  # keys, as GLFW numbers them
REFRESH_S = 0.04
GLASS = 0.35  # opacity of what may hide whiskers


def check_display() -> None:
    """Refuse to open a window where that is not possible.

    Raises:
        ConfigError: there is no display, or it cannot be reached.
    """
    instead = "write a picture or video with --out"
    if not has_display():
        raise ConfigError(f"no display to open a window on: {instead}")
    try:
        import glfw

        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            ready = glfw.init()
    except Exception as error:  # its library is missing, or too old
        raise ConfigError(f"no window can be opened ({error}): {instead}") from None
    if not ready:
        why = "; ".join(str(w.message) for w in said) or "GLFW does not start"
        raise ConfigError(f"no window can be opened ({why}): {instead}")


def show(footage: Footage, camera: Camera, scale: ForceScale, slow: float = 10.0) -> None:
    """Play footage over and over in a window, until it is closed.

    The space bar stops and starts the time, the arrow keys step it; the mouse turns, moves and
    zooms. It plays `slow` times slower than it was.

    Raises:
        ConfigError: there is no display, or no window can be opened on it.
    """
    check_display()
    from mujoco import viewer

    dressed = Dressed(footage.model, footage.spec)
    dressed.thicken(camera.extent_mm)
    dressed.cover(GLASS)
    player = _Player(len(footage), footage.period_ms * 1e-3 * slow)
    first = mujoco.MjvCamera()
    camera.aim(dressed.model, first)
    dressed.pose(footage, 0, scale)
    with viewer.launch_passive(
        dressed.model,
        dressed.data,
        key_callback=player.key,
        show_left_ui=False,
        show_right_ui=False,
    ) as window:
        with window.lock():
            camera.aim(dressed.model, window.cam)
        while window.is_running():
            moment = player.moment(time.monotonic())
            with window.lock():
                dressed.pose(footage, moment, scale)
                window.user_scn.ngeom = 0
                loads = footage.loads[moment]
                add_forces(window.user_scn, dressed, loads, scale, camera.extent_mm)
                add_paper(window.user_scn, camera)
            window.set_texts(
                (
                    None,
                    mujoco.mjtGridPos.mjGRID_TOPLEFT,
                    "time\narrows\nspace, arrow keys",
                    f"{footage.times_ms[moment]:.0f} ms\n"
                    f"{scale.arrow_mm:g} mm: {scale.top_mn:g} mN\n"
                    "stop and go, step",
                )
            )
            window.sync()
            time.sleep(REFRESH_S)


class _Player:
    """Which moment is due: it runs, stops and steps."""

    def __init__(self, moments: int, period_s: float) -> None:
        self._moments, self._period = moments, period_s
        self._at, self._since, self._running = 0.0, 0.0, True

    def moment(self, now_s: float) -> int:
        """The moment to show; called often."""
        if self._running and self._since:
            self._at += (now_s - self._since) / self._period
        self._since = now_s
        return int(self._at) % self._moments

    def key(self, code: int) -> None:
        """A key was pressed."""
        if code == SPACE:
            self._running = not self._running
        elif code in (LEFT, RIGHT):
            self._running = False
            self._at += 1 if code == RIGHT else -1
