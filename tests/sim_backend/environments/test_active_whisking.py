"""Active touch for agents: what Gymnasium asks of an environment, and what the page says of it."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.sim_backend.environments import ENVIRONMENT, WHISKERS
from tactile_rt.sim_backend.environments.active_whisking import KINDS, LOGITS, ActiveWhisking
from tactile_rt.sim_backend.environments.whisking_head import WhiskingHead, place_beside
from tactile_rt.sim_backend.whisking_drive import LAG_S, Whisking
from tactile_rt.sim_backend.world import PROFILES


def few(**how: object) -> ActiveWhisking:
    """Two whiskers: the cheapest environment."""
    return ActiveWhisking(**({"whiskers": ("B1", "C2"), "render_mode": "rgb_array"} | how))  # type: ignore[arg-type]


def doing(env: ActiveWhisking, *motion: float) -> np.ndarray:
    """An action: the first numbers as given, the rest 0."""
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[: len(motion)] = motion
    return action


# ---- what Gymnasium asks


@pytest.mark.parametrize("task", ["classify", "locate"])
def test_the_checker_finds_nothing(task: str) -> None:
    """A warning of it is an error here."""
    made = gymnasium.make(ENVIRONMENT, task=task, whiskers=("B1", "C2"), render_mode="rgb_array")
    check_env(made.unwrapped)


@pytest.mark.parametrize("imports", ["gymnasium", "tactile_rt, gymnasium", "gymnasium, tactile_rt"])
def test_it_is_made_by_its_name_whatever_is_imported_first(imports: str) -> None:
    name = "tactile_rt.sim_backend.environments:tactile_rt/ActiveWhisking-v0"
    code = (
        f"import {imports}\n"
        f"env = gymnasium.make({name!r}, task='locate')\n"
        "print(env.spec.max_episode_steps, *env.unwrapped.array_spec.elements)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().split() == ["40", *WHISKERS]


def test_without_gymnasium_the_package_is_imported_all_the_same() -> None:
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from tactile_rt.sim_backend import environments"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_many_at_once_are_what_one_is(mode: str) -> None:
    apart = {"context": "spawn"} if mode == "async" else {}
    many = gymnasium.make_vec(
        ENVIRONMENT, 2, vectorization_mode=mode, vector_kwargs=apart, whiskers=("B1", "C2")
    )
    alone = [few(render_mode=None) for _ in range(2)]
    seen, _ = many.reset(seed=[3, 4])
    want = [env.reset(seed=s)[0] for env, s in zip(alone, (3, 4), strict=True)]
    actions = np.stack([doing(env, 0.5, 0.0, 0.0, 1.0, 0.1 * i) for i, env in enumerate(alone)])
    for _ in range(3):
        for key in seen:
            np.testing.assert_array_equal(seen[key], np.stack([w[key] for w in want]))
        seen, rewards, *_ = many.step(actions)
        stepped = [env.step(action) for env, action in zip(alone, actions, strict=True)]
        want = [s[0] for s in stepped]
        assert rewards.tolist() == [s[1] for s in stepped]
    many.close()


def test_a_seed_and_actions_are_all_that_counts() -> None:
    def play(env: ActiveWhisking, seed: int) -> tuple[list[np.ndarray], dict[str, object]]:
        seen, told = env.reset(seed=seed)
        felt = [seen["loads"]]
        for k in range(8):
            seen, _, _, _, told = env.step(doing(env, 0.4, 0.2 * (k % 2), 0.0, 1.0, -0.3))
            felt.append(seen["loads"])
        return felt, told

    one, other = few(), few()
    play(other, 1)  # what went before does not matter
    first, told = play(one, 7)
    second, again = play(other, 7)
    np.testing.assert_array_equal(first, second)
    assert told["object"] == again["object"] and told["touches"] == again["touches"]
    third, _ = play(one, 8)
    assert not np.array_equal(first[-1], third[-1])


# ---- what happens


def test_an_array_that_goes_ahead_and_whisks_touches_and_one_that_holds_still_does_not() -> None:
    env = few()
    env.reset(seed=0, options={"object": "mug-3"})
    for _ in range(5):
        seen, *_, told = env.step(doing(env, -1.0))
    assert told["touches"] == 0 and not told["touching"].any() and not seen["angle"].any()
    assert abs(seen["loads"][..., :3]).max() < 5e-5, "noise"
    for _ in range(30):
        seen, *_, told = env.step(doing(env, 0.5, 0.0, 0.0, 0.7))
    assert told["touches"] > 3 and told["object"] == "mug-3"
    assert told["label"] == KINDS.index("mug")
    picture = env.render()
    assert picture is not None and picture.shape == (320, 640, 3) and picture.std() > 10


def test_whiskers_turn_by_amplitude_and_offset() -> None:
    env = few(noise=0.0)
    env.reset(seed=0)
    angles = []
    for k in range(30):
        seen, *_ = env.step(doing(env, -1.0, 0.5) if k < 20 else doing(env, 1.0, 0.5))
        angles.append(seen["angle"])
    assert angles[19] == pytest.approx(0.225, abs=1e-3)
    whisked = np.concatenate(angles[-5:])
    # means over 10 ms of 8 Hz: a little less than the amplitude of 0.45 rad
    assert np.ptp(whisked) / 2 == pytest.approx(0.45, rel=0.03)
    assert whisked.mean() == pytest.approx(0.225, abs=0.02)


def test_enough_touches_end_an_episode() -> None:
    env = few(touches=2)
    env.reset(seed=0, options={"object": "mug-3"})
    for _ in range(60):
        *_, done, cut, told = env.step(doing(env, 0.5, 0.0, 0.0, 0.7))
        assert done == (told["touches"] >= 2) and not cut
        if done:
            return
    pytest.fail("no two touches")


def test_a_guess_is_judged_by_the_truth() -> None:
    env = few(kinds=("mug", "table"))
    _, told = env.reset(seed=0)
    sure = doing(env)
    sure[5:] = [1, -1] if told["label"] == 0 else [-1, 1]
    assert env.step(sure)[1] == pytest.approx(-np.log1p(np.exp(-2 * LOGITS)))
    assert env.step(doing(env))[1] == pytest.approx(-np.log(2))
    env = few(task="locate")
    _, told = env.reset(seed=0)
    guess = doing(env)
    guess[5:] = told["centre_mm"] / env.reach_mm
    assert env.step(guess)[1] == pytest.approx(0, abs=1e-6)
    guess[6] += 0.25
    assert env.step(guess)[1] == pytest.approx(-0.25, abs=1e-6)


def test_whiskers_that_jam_cut_an_episode_short(monkeypatch: pytest.MonkeyPatch) -> None:
    def jam(*_: object) -> None:
        raise SourceError("jammed")

    env = few()
    env.reset(seed=0)
    monkeypatch.setattr(WhiskingHead, "advance", jam)
    seen, _, done, cut, told = env.step(doing(env))
    assert cut and not done and told["jammed"] and seen in env.observation_space


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"task": "guess"}, "task must be classify or locate"),
        ({"kinds": ("mug",)}, "kinds must be two or more"),
        ({"instances": (3, 3)}, "instances must be"),
        ({"step_ms": 12}, "step_ms must be a multiple of 5"),
        ({"whiskers": ("C2", "Z9")}, "has no whisker Z9"),
        ({"noise": -1.0}, "noise"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        few(**wrong)


def test_mistakes_of_an_agent_are_named() -> None:
    env = few()
    with pytest.raises(ConfigError, match="reset the environment"):
        env.step(doing(env))
    with pytest.raises(ConfigError, match="is of none of the kinds"):
        env.reset(options={"object": "house-2"})
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=r"an action is \(13,\) finite numbers"):
        env.step(np.full(13, np.nan, dtype=np.float32))
    seen, *_ = env.step(np.full(13, 1e9, dtype=np.float32))  # beyond the box is its edge
    assert seen in env.observation_space


# ---- the head


def head() -> WhiskingHead:
    array = few()._array
    placed = place_beside(
        array, "mug-3", size_mm=40, yaw_deg=0, height_mm=0, distance_mm=6.5, gap_mm=3
    )
    assert placed is not None
    return WhiskingHead(array, placed, PROFILES["realtime"], Whisking(8.0, 0.0, 0.0))


def test_the_head_goes_as_told_and_stays_in_its_box() -> None:
    one = head()
    one.advance(1000, (0, 2.0, 0))
    # three lags behind a point at 2 mm/s
    assert one.position == pytest.approx([0, 2.0 - 2.0 * 3 * LAG_S, 0], abs=2e-3)
    assert one.velocity == pytest.approx([0, 2.0, 0], abs=1e-3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        one.advance(50, rng.choice([-1, 1], 3) * 300.0)
        assert (one.position >= one.placed.low).all() and (one.position <= one.placed.high).all()


def test_position_velocity_and_acceleration_of_the_head_agree() -> None:
    one = head()
    ways, pulls = [], []
    for command in ((0, 60, 10), (-30, 20, 0), (0, 0, -60)):
        way, pull = one._move(100, np.array(command, dtype=float))
        ways.append(way[:-1])
        pulls.append(pull)
    way, pull = np.concatenate(ways), np.concatenate(pulls)
    bend = way[2:] - 2 * way[1:-1] + way[:-2]  # mm/ms^2 at the samples' ends
    middle = (pull[1:] + pull[:-1]) / 2
    assert abs(bend - middle[: len(bend)]).max() < 0.02 * abs(bend).max()


def test_touches_are_counted_anew_after_a_pause() -> None:
    one = head()
    touching = np.zeros((40, 2), dtype=bool)
    touching[5:9, 0] = touching[12:20, 0] = touching[35:, 0] = True  # 3 ms free, 15 ms free
    touching[0, 1] = touching[39, 1] = True
    assert one._count_touches(touching[:13]) + one._count_touches(touching[13:]) == 4
