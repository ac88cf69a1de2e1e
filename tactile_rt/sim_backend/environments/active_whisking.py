"""`ActiveWhisking`: an agent moves a head, whisks, and guesses an object's kind or place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tactile_rt.core.errors import ConfigError, SourceError, name_some
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.environments.whisking_head import Stretch, WhiskingHead, place_beside
from tactile_rt.sim_backend.objects.catalogue import promised_object
from tactile_rt.sim_backend.rods.chains import Pose, place
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep import usual_distance, usual_size
from tactile_rt.sim_backend.whisking_drive import Whisking
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, array_spec, stamp_samples

Floats = NDArray[np.float64]

SIDE, MARGIN_MM = 320, 25.0
PAPER, THING, EDGE = (255, 255, 255), (214, 186, 140), (170, 130, 80)
WHISKER, TOUCHING = (60, 60, 70), (200, 40, 40)
VIEWS = ((0, 1), (1, 2))  # from above: x to the right, y up; from the side: y to the right, z up
# Kinds of the catalogue with differences that whiskers can feel: edges, rims, gaps, curves.
KINDS: Final = ("bottle", "bowl", "car", "chair", "gear", "mug", "mushroom", "table")
FREQUENCY_HZ: Final = 8.0
AMPLITUDE_RAD: Final = 0.45
OFFSET_RAD: Final = 0.45
SPEED_MM_S: Final = 60.0
MOTION: Final = ("amplitude", "offset", "velocity x", "velocity y", "velocity z")
LOGITS: Final = 5.0  # guesses of +1 for a kind and -1 for another differ by 2 x 5 in their logits
FRAMES: Final = 5  # means of samples in a step
FULL_SCALE: Final = (*(5e-3,) * 3, *(2e-5,) * 3)  # N, N m: larger readings saturate
DRAWS: Final = 100  # tries to place an object where whiskers meet it
Observation = dict[str, NDArray[np.float32]]


def whisker_nodes(head: WhiskingHead) -> list[Floats]:
    """Return the (node, 3) points of every whisker, base to tip, in the world, mm."""
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
    """Draw two views of object and whiskers, red if touching: (320, 640, 3) RGB."""
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
        scale, origin = np.array((1, -1)) * (SIDE / span), (panel * SIDE + SIDE / 2, SIDE / 2)
        for points in (points[:, axes] for points in corners):
            outline = points[ConvexHull(points).vertices]
            places = ((outline - middle) * scale + origin).ravel().tolist()
            draw.polygon(places, fill=THING, outline=EDGE)
        for line, touches in zip(whisker_nodes(head), touching, strict=True):
            places = ((line[:, axes] - middle) * scale + origin).ravel().tolist()
            draw.line(places, fill=TOUCHING if touches else WHISKER, width=2)
    return np.asarray(image, dtype=np.uint8)


class ActiveWhisking(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A Gymnasium environment of active touch: move, whisk, and guess an object's kind or place.

    `reset` places an object of one of the kinds, at a random yaw, ahead of the array on the side
    to which its whiskers reach, just out of their reach at rest. In each step the action sets the
    velocity of the head and the whisking at 8 Hz; both change smoothly, see `whisking_drive`. The
    head stays in a box beside the object, so that it never runs into it.

    **Action**, (5 + guess,) in [-1, 1]:

    ==== ====================================================================================
    0    amplitude of the whisking: -1 is 0, whiskers held still; 1 is 0.45 rad (26 degrees)
    1    offset of the whisking from rest, times 0.45 rad, rostral positive
    2-4  velocity of the head in the world, times 60 mm/s for a mouse: x lateral, y rostral
         (towards the object at first), z up
    5-   the guess. ``classify``: a logit for each kind, times 5. ``locate``: the object's centre
         from the head's origin, along the world's x, y and z, times `reach_mm`
    ==== ====================================================================================

    **Observation**, a dictionary of float32 arrays in SI units:

    ========= =============================================================================
    loads     (5, element, channel) means over fifths of the step of the channels in
              `array_spec`: forces (N) and moments (N m) at the bases, with the sensor's noise
    angle     (5,) mean protraction from rest in the same fifths, rad
    head      (6,) displacement of the head from its start (m), and its velocity (m/s)
    ========= =============================================================================

    **Reward** of each step: ``classify``, the logarithm of the probability that the guess gives the
    true kind, at most 0; ``locate``, minus the distance between the guess and the object's centre
    in units of `reach_mm`.

    An episode ends (terminated) when whiskers have begun to touch `touches` times, or (truncated)
    after the registered number of steps, 40, or if whiskers jam so that the simulation fails. With
    the same seed and actions it is the same on every machine.

    Args:
        whiskers: the names of the array's whiskers to include; all if empty.
        kinds: categories of objects, see `objects.catalogue`; a label is an index into them.
        instances: the range of instance numbers of each kind: the first, and the last plus one.
        touches: the number of touches that ends an episode; 0 for no limit.
        step_ms: the length of a step, a multiple of 5 ms.
        noise: sensor noise, in multiples of the rated 10 uN and 0.05 uN m per sample.
        render_mode: ``rgb_array`` for pictures (extra ``view``).

    Attributes:
        reach_mm: The distance that a guess of 1 stands for, mm.
        speed_mm_s: The largest commanded speed of the head along an axis, mm/s.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(
        self,
        task: Literal["classify", "locate"] = "classify",
        array: str = "mouse",
        whiskers: Sequence[str] = (),
        kinds: Sequence[str] = KINDS,
        instances: tuple[int, int] = (0, 44),
        touches: int = 0,
        step_ms: int = 50,
        noise: float = 1.0,
        profile: str = "realtime",
        render_mode: str | None = None,
    ) -> None:
        if task not in ("classify", "locate"):
            raise ConfigError(f"task must be classify or locate, not {task!r}")
        if len(kinds) < 2:
            raise ConfigError("kinds must be two or more")
        for kind in kinds:
            promised_object(f"{kind}-0")  # raises if the kind does not exist
        if not 0 <= instances[0] < instances[1]:
            raise ConfigError(f"instances must be (first, one after the last), not {instances}")
        if touches < 0:
            raise ConfigError(f"touches must be 0 or more, not {touches}")
        if step_ms < FRAMES or step_ms % FRAMES:
            raise ConfigError(f"step_ms must be a multiple of {FRAMES}, not {step_ms}")
        if profile not in PROFILES:
            raise ConfigError(f"no profile {profile!r}: there are {', '.join(PROFILES)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"render_mode must be rgb_array, not {render_mode!r}")
        self.render_mode = render_mode
        whole = load_array(array)
        self._array = _select_whiskers(whole, whiskers)
        self._task, self._kinds, self._instances = task, tuple(kinds), instances
        self._touches, self._samples = touches, round(step_ms / SAMPLE_MS)
        self._profile = PROFILES[profile]
        self._sensors = SensorModel(noise_force=1e-5 * noise, noise_moment=5e-8 * noise)
        self._distance_mm = usual_distance((whole,))
        self._size_mm = usual_size((whole,))
        self._scale = self._distance_mm / 6.5  # relative to a mouse
        self.array_spec = array_spec(self._array.whiskers, self._array.name)
        self.reach_mm = 2 * self._size_mm
        self.speed_mm_s = SPEED_MM_S * self._scale
        guess = len(kinds) if task == "classify" else 3
        self.action_space = spaces.Box(-1.0, 1.0, (len(MOTION) + guess,), np.float32)
        loads = np.broadcast_to(
            np.array(FULL_SCALE, dtype=np.float32), (FRAMES, *self.array_spec.shape)
        )
        most = np.float32(AMPLITUDE_RAD + OFFSET_RAD)
        head = np.repeat(np.array([1.0, 2e-3 * self.speed_mm_s], dtype=np.float32), 3)
        self._limits = {"loads": loads, "angle": np.full(FRAMES, most), "head": head}
        self.observation_space = spaces.Dict(  # type: ignore[assignment]
            {key: spaces.Box(-top, top, dtype=np.float32) for key, top in self._limits.items()}
        )
        self._head: WhiskingHead | None = None
        self._sensor: Sensor | None = None
        self._object = ""
        self._label = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Place a new object, and return the first observation and info.

        Args:
            options: ``{"object": "mug-50"}`` names the object, which must be of one of the kinds.

        Raises:
            ConfigError: no such object, or no whisker meets the object.
        """
        super().reset(seed=seed)
        rng = self.np_random
        named = (options or {}).get("object")
        for _ in range(DRAWS):
            kind = self._kinds[rng.integers(len(self._kinds))]
            name = f"{kind}-{rng.integers(*self._instances)}"
            placed = place_beside(
                self._array,
                str(named or name),
                size_mm=self._size_mm,
                yaw_deg=float(rng.uniform(0, 360)),
                height_mm=float(rng.uniform(-8, 4)) * self._scale,
                distance_mm=float(rng.uniform(5.5, 8)) * self._scale,
                gap_mm=float(rng.uniform(0.5, 4)) * self._scale,
            )
            if placed is not None:
                break
        else:
            raise ConfigError(f"no whisker meets {named or 'any object'}: take another array")
        category = placed.name.rpartition("-")[0]
        if category not in self._kinds:
            raise ConfigError(f"{placed.name} is of none of the kinds {name_some(self._kinds)}")
        self._object, self._label = placed.name, self._kinds.index(category)
        self._head = WhiskingHead(
            self._array, placed, self._profile, Whisking(FREQUENCY_HZ, 0.0, 0.0)
        )
        self._sensor = Sensor(self._sensors, self.array_spec, int(rng.integers(1 << 62)))
        felt = self._head.advance(self._samples)  # at rest: nothing touches
        return self._make_observation(felt), self._make_info(felt)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move and whisk for one step, and reward the guess in the action.

        Raises:
            ConfigError: before the first `reset`, or the action has another shape or is not finite.
        """
        head = self._head
        values = np.asarray(action, dtype=np.float64)
        if head is None:
            raise ConfigError("reset the environment before its first step")
        if values.shape != self.action_space.shape or not np.isfinite(values).all():
            raise ConfigError(
                f"an action is {self.action_space.shape} finite numbers, see ActiveWhisking"
            )
        values = np.clip(values, -1.0, 1.0)
        amplitude = (values[0] + 1) / 2 * AMPLITUDE_RAD
        head.command(Whisking(FREQUENCY_HZ, float(amplitude), float(values[1] * OFFSET_RAD)))
        guess = values[len(MOTION) :]
        try:
            felt = head.advance(self._samples, values[2:5] * self.speed_mm_s)
            jammed = False
        except SourceError:
            nothing = np.zeros((self._samples, *self.array_spec.shape))
            felt = Stretch(nothing, np.zeros(self._samples), nothing[..., 0] > 0, 0)
            jammed = True
        done = bool(self._touches and head.touches >= self._touches)
        info = self._make_info(felt) | {"jammed": jammed}
        return self._make_observation(felt), self._compute_reward(guess), done, jammed, info

    def render(self) -> Any:
        """Draw top and side views, (320, 640, 3) RGB; None without a render mode."""
        if self.render_mode is None or self._head is None:
            return None
        return picture(self._head)

    def _make_observation(self, felt: Stretch) -> Observation:
        assert self._head is not None and self._sensor is not None
        loads = felt.loads.astype(np.float32)
        read = self._sensor.push(stamp_samples(loads, self._head.samples - len(loads)))
        assert read is not None
        means = read.values.reshape(FRAMES, -1, *self.array_spec.shape).mean(1, dtype=np.float64)
        head = np.concatenate([self._head.position, self._head.velocity]) * 1e-3
        angle = felt.angle.reshape(FRAMES, -1).mean(axis=1)
        return {
            key: np.clip(value, -self._limits[key], self._limits[key]).astype(np.float32)
            for key, value in (("loads", means), ("angle", angle), ("head", head))
        }

    def _make_info(self, felt: Stretch) -> dict[str, Any]:
        assert self._head is not None
        return {
            "object": self._object,
            "label": self._label,
            "centre_mm": self._get_centre(),
            "touches": self._head.touches,
            "touching": felt.touching.any(axis=0),
        }

    def _get_centre(self) -> Floats:
        """Return the object's centre (3,) relative to the head's origin, mm, in world axes."""
        assert self._head is not None
        return self._head.placed.centre - self._head.position

    def _compute_reward(self, guess: Floats) -> float:
        if self._task == "classify":
            logits = guess * LOGITS
            return float(logits[self._label] - np.log(np.exp(logits).sum()))
        return -float(np.linalg.norm(guess * self.reach_mm - self._get_centre())) / self.reach_mm


def _select_whiskers(array: WhiskerArray, names: Sequence[str]) -> WhiskerArray:
    """Return the array with only the named whiskers; without names, the whole array."""
    if not names:
        return array
    known = {w.name: w for w in array.whiskers}
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"array {array.name} has no whisker {unknown[0]}: {name_some(known, 8)}")
    return replace(array, whiskers=tuple(w for w in array.whiskers if w.name in names))
