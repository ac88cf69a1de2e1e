"""The array that whisks: its drive against an independent integration; the source over a wire."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk, Source, concatenate
from tactile_rt.drivers.codecs.native import NativeOptions, NativeSerial, frame
from tactile_rt.drivers.codecs.native_common import IMPOSSIBLE, MessageType
from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.whisking_drive import LAG_S, LARGEST_RAD, MOST, Drive, Whisking
from tactile_rt.sim_backend.whisking_source import WhiskingOptions, WhiskingSource
from tactile_rt.sim_backend.world import array_spec
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeCan, FakeSerial
from tests.helpers.refusals import refusal
from tests.helpers.source_contract import take
from tests.helpers.waiting import until

ROBOT = Path(__file__).parents[2] / "docs" / "arrays" / "robot.csv"
Commands = list[tuple[float, Whisking]]


# ---- the drive


def integrated(commands: Commands, t_s: np.ndarray) -> np.ndarray:
    """The protraction by numerical integration of the lags and the phase, from the definition."""

    def slopes(aim: np.ndarray) -> Callable[[float, np.ndarray], np.ndarray]:
        def slope(t: float, y: np.ndarray) -> np.ndarray:
            lags = y[:9].reshape(3, 3)
            before = np.concatenate([aim[None], lags[:-1]])
            return np.append(((before - lags) / LAG_S).ravel(), 2 * np.pi * lags[2, 0])

        return slope

    state = np.zeros(10)
    state[[0, 3, 6]] = commands[0][1].frequency_hz  # it whisks at once, with no amplitude yet
    angles = np.empty(len(t_s))
    ends = [t for t, _ in commands[1:]] + [math.inf]
    for (start, command), end in zip(commands, ends, strict=True):
        amplitude = command.amplitude_rad if command.frequency_hz else 0.0
        aim = np.array([command.frequency_hz, amplitude, command.offset_rad])
        here = (t_s >= start) & (t_s < end)
        until = end if math.isfinite(end) else t_s[-1]
        asked = np.append(t_s[here], until)
        found = solve_ivp(
            slopes(aim), (start, until), state, "DOP853", np.unique(asked), rtol=1e-10, atol=1e-11
        )
        y = found.y[:, : here.sum()]
        angles[here] = y[8] + y[7] * np.sin(y[9])
        state = found.y[:, -1]
    return angles


def driven(commands: Commands, t_s: np.ndarray) -> np.ndarray:
    """What the drive does, asked up to each command before the command is given."""
    drive = Drive(commands[0][1])
    angles = []
    ends = [t for t, _ in commands[1:]] + [math.inf]
    for (start, command), end in zip(commands, ends, strict=True):
        if start:
            drive.command(command, start)
        angles.append(drive.protraction(t_s[(t_s >= start) & (t_s < end)]))
    return np.concatenate(angles)


CHANGES: Commands = [
    (0.0, Whisking(8.0, 0.35, 0.0)),
    (0.4005, Whisking(15.0, 0.2, -0.4)),
    (0.42, Whisking(0.0, 0.5, 0.3)),  # before the last change is through, and to a stop
    (0.9, Whisking(2.0, 0.6, 0.4)),
]


def test_the_drive_is_what_an_independent_integration_gives() -> None:
    t = np.arange(3000) * 5e-4
    np.testing.assert_allclose(driven(CHANGES, t), integrated(CHANGES, t), rtol=0, atol=1e-7)


def test_it_settles_at_what_is_commanded() -> None:
    t = np.arange(2.0, 4.0, 1e-3)
    np.testing.assert_allclose(
        Drive(Whisking(8.0, 0.35, -0.1)).protraction(t),
        -0.1 + 0.35 * np.sin(2 * np.pi * 8.0 * t),
        atol=1e-9,
    )
    drive = Drive(Whisking(8.0, 0.35, -0.1))
    drive.command(Whisking(0.0, 0.3, 0.2), 1.0)
    np.testing.assert_allclose(drive.protraction(t), 0.2, atol=1e-6)
    share = drive.protraction(np.array([1.0 + 8.4 * LAG_S]))  # "99 % after a third of a second"
    assert share[0] == pytest.approx(0.2, abs=0.01 * 0.65)


def random_commands(seed: int) -> Commands:
    """Commands at the ends of all ranges, in quick and slow succession."""
    rng = np.random.default_rng(seed)
    commands: Commands = []
    t = 0.0
    while len(commands) < 60:
        low, high = sorted(rng.choice([-1.0, -0.3, 0.0, 0.4, 1.0], 2) * LARGEST_RAD)
        amplitude = (high - low) / 2
        fastest = 30.0 if amplitude == 0 else min(30.0, math.sqrt(1e4 / amplitude) / (2 * math.pi))
        frequency = fastest * (1 - 1e-9) * float(rng.choice([0.0, 0.3, 1.0, 1.0]))
        commands.append((t, Whisking(frequency, amplitude * (1 - 1e-9), (high + low) / 2)))
        t = round(t + float(rng.choice([0.002, 0.04, 0.1, 0.3])), 4)
    return commands


@pytest.mark.parametrize("seed", range(5))
def test_no_sequence_of_commands_makes_it_jump_or_leave_its_range(seed: int) -> None:
    commands = random_commands(seed)
    h = 1e-4
    t = np.arange(0, commands[-1][0] + 0.3, h)
    angle = driven(commands, t)
    assert np.abs(angle).max() <= LARGEST_RAD + 1e-9
    acceleration = np.diff(angle, 2) / h**2
    assert 1e3 < np.abs(acceleration).max() <= MOST
    # A jump of the angle by 1e-6 rad, or of the velocity by 0.1 rad/s, would show as more than
    # the acceleration changes in a step, the greatest of which is its bound times the fastest rate.
    assert np.abs(np.diff(angle)).max() / h < 250
    assert np.abs(np.diff(acceleration)).max() < MOST * h * (3 / LAG_S + 2 * np.pi * 30 * 2)


def test_angles_do_not_depend_on_when_they_are_asked_for() -> None:
    t = np.arange(2000) * 5e-4
    one, other = Drive(CHANGES[0][1]), Drive(CHANGES[0][1])
    one.command(CHANGES[1][1], 0.5)
    other.command(CHANGES[1][1], 0.5)
    pieces = [other.protraction(t[i : i + 7]) for i in range(0, len(t), 7)]
    np.testing.assert_array_equal(one.protraction(t), np.concatenate(pieces))


def test_the_past_stays_as_it_was() -> None:
    drive = Drive(CHANGES[0][1])
    t = np.arange(400) * 1e-3
    before = drive.protraction(t)
    drive.command(CHANGES[1][1], 0.4)
    np.testing.assert_array_equal(drive.protraction(t), before)
    with pytest.raises(ValueError, match="a command at"):
        drive.command(CHANGES[1][1], 0.3)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ((31.0, 0.1, 0.0), "frequency must be 0 to 30 Hz, not 31"),
        ((math.nan, 0.1, 0.0), "frequency must be 0 to 30 Hz, not nan"),
        ((8.0, -0.1, 0.0), "amplitude must be 0 to 1.05 rad"),
        ((8.0, 0.6, 0.6), "an offset of 0.6 rad with an amplitude of 0.6 leaves the range"),
        ((25.0, 0.9, 0.0), "accelerate by 22207 rad/s^2, more than 10000: whisk at 16.7 Hz"),
    ],
)
def test_what_is_out_of_range_is_refused(asked: tuple[float, float, float], said: str) -> None:
    assert said in refusal(Whisking, *asked)


# ---- the source


def fast(**options: object) -> WhiskingSource:
    return WhiskingSource(str(ROBOT), WhiskingOptions(pace="fast", **options))  # type: ignore[arg-type]


def test_it_describes_the_array_with_its_angle() -> None:
    with open_source("whisking:mouse?pace=fast") as source:
        spec = array_spec(mouse_whiskers(), "mouse-right")
        assert source.spec.channels == (*spec.channels, "angle")
        assert source.spec.units == (*spec.units, "rad")
        assert source.spec.elements == spec.elements
        assert source.spec.orientations == spec.orientations


def test_the_angle_is_what_is_commanded() -> None:
    with fast(frequency_hz=10, amplitude_deg=25, offset_deg=-5) as source:
        stream = take(source, 1404)
    np.testing.assert_array_equal(np.diff(stream.seq), 1)
    np.testing.assert_array_equal(stream.t_ns, stream.seq * 1_000_000)
    late = stream.values[1000:]
    steps = stream.seq[1000:, None] * 1e-3 + np.array([0.0, 5e-4])  # two physics steps each
    want = np.radians(-5 + 25 * np.sin(2 * np.pi * 10 * steps)).mean(axis=1)
    np.testing.assert_allclose(late[:, :, 6], want[:, None].repeat(late.shape[1], 1), atol=1e-6)
    # What accelerates has weight: without contact the follicles feel the whiskers' inertia.
    assert 1e-9 < np.abs(late[:, :, :3]).max() < 1e-1


def test_the_same_commands_at_the_same_samples_give_the_same_stream() -> None:
    streams = []
    for asked in (0.3, 0.3, 0.2):
        with fast() as source:
            first = take(source, 99)
            source.set_whisking(12.0, asked, 0.1)
            rest = take(source, 300)
            assert source.commands == [
                (0, Whisking(8.0, math.radians(20), 0.0)),
                (99, Whisking(12.0, asked, 0.1)),
            ]
        streams.append(concatenate([first, rest]).values)
    np.testing.assert_array_equal(streams[0], streams[1])
    np.testing.assert_array_equal(streams[0][:99], streams[2][:99])
    assert not np.array_equal(streams[0], streams[2])


def test_a_refused_command_changes_nothing() -> None:
    with fast() as source, fast() as other:
        take(source, 99)
        with pytest.raises(ConfigError, match="frequency must be 0 to 30 Hz, not 40"):
            source.set_whisking(40.0, 0.1, 0.0)
        values = take(source, 99).values
        np.testing.assert_array_equal(values, take(other, 198).values[99:])
        assert len(source.commands) == 1


def test_an_object_beside_it_is_felt_at_its_distance() -> None:
    felt = []
    for thing in ("&object=mug-1&position_mm=22,6,0", "&object=mug-1&position_mm=60,6,0", ""):
        with open_source(f"whisking:mouse?pace=fast{thing}") as source:
            stream = concatenate([source.read() for _ in range(28)])
            felt.append(np.abs(stream.values[:, :, 3:6]))
    near, far, air = felt
    np.testing.assert_allclose(far, air, atol=1e-12)
    assert near.max() > 5 * air.max()


def test_sensors_read_the_loads_poorly_and_the_angle_truly() -> None:
    with fast() as clean, fast(gain=0.2, noise_force=1e-3, drop_probability=0.3) as poor:
        true, read = take(clean, 405), take(poor, 200)
        assert poor.stats.missing > 50
    np.testing.assert_array_equal(read.values[..., 6], true.values[read.seq][..., 6])
    assert np.abs(read.values - true.values[read.seq])[..., 0].std() > 1e-4


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("whisking:mose", "no simulated array 'mose': did you mean mouse"),
        ("whisking:mouse?frequency_hz=99", "frequency must be 0 to 30 Hz, not 99"),
        ("whisking:mouse?amplitude_deg=50&offset_deg=30", "leaves the range of 1.05 rad"),
        ("whisking:mouse?object=mugg", "no object called 'mugg'"),
        ("whisking:mouse?position_mm=1,2", "position_mm must be three numbers x,y,z"),
        ("whisking:mouse?size_mm=0", "size_mm must be above 0"),
        ("whisking:mouse?object=mug-1&position_mm=6,4,0", "inside the object: move it away"),
        ("whisking:mouse?amplitude=3", "has no option 'amplitude'; did you mean amplitude_deg?"),
    ],
)
def test_a_mistake_is_told(url: str, said: str) -> None:
    assert said in refusal(open_source, url)


# ---- over a wire


@pytest.fixture
def still() -> Iterator[WhiskingSource]:
    with fast(amplitude_deg=0) as source:
        yield source


@pytest.mark.parametrize("make", [FakeSerial, FakeCan])
def test_the_angle_follows_a_command_sent_over_the_wire(
    make: type[FakeSerial | FakeCan], still: WhiskingSource, no_thread_left: None
) -> None:
    options = {"format": "float32"}
    with make(still, options=options) as fake, open_source(fake.url) as driver:
        came: list[Chunk] = []
        read_until(driver, came, lambda: sum(map(len, came)) >= 100)
        driver.set_whisking(10.0, 0.3, 0.1)  # type: ignore[attr-defined]
        read_until(driver, came, lambda: len(still.commands) == 2)
        number, command = still.commands[1]
        assert dataclasses.astuple(command) == pytest.approx((10.0, 0.3, 0.1), abs=1e-4)
        read_until(driver, came, lambda: sum(map(len, came)) >= number + 700)
        assert driver.spec == still.spec
    stream = concatenate(came)
    angle = stream.values[:, 0, 6]
    assert np.abs(angle[:number]).max() == 0
    assert angle[-200:].max() == pytest.approx(0.4, abs=2e-3)
    assert angle[-200:].min() == pytest.approx(-0.2, abs=2e-3)
    # And every bit is that of a source that is told the same at the same sample.
    with fast(amplitude_deg=0) as same:
        head = take(same, number)
        same.set_whisking(*dataclasses.astuple(command))
        want = concatenate([head, take(same, len(stream) - number + 9)]).values[: len(stream)]
    np.testing.assert_array_equal(stream.values, want)


def test_a_command_out_of_range_is_not_acknowledged(
    still: WhiskingSource, no_thread_left: None
) -> None:
    device, host = NativeSerial(NativeOptions()), NativeSerial(NativeOptions())
    device.may_whisk = still.may_whisk
    answer = device.respond(host.whisk(40.0, 0.1, 0.0).send)
    assert answer == frame(MessageType.ACK, bytes((MessageType.WHISK, IMPOSSIBLE)))
    assert device.whisking is None
    for make in (FakeSerial, FakeCan):
        with make(still) as fake, open_source(fake.url) as driver:
            driver.set_whisking(40.0, 0.1, 0.0)  # type: ignore[attr-defined]
            driver.set_whisking(9.0, 0.1, 0.0)  # type: ignore[attr-defined]
            read_until(driver, [], lambda fake=fake: fake.codec.whisking is not None)
            assert fake.codec.whisking == pytest.approx((9.0, 0.1, 0.0))
            read_until(driver, [], lambda: still.commands[-1][1].frequency_hz == 9.0)
    assert all(c.frequency_hz < 10 for _, c in still.commands)


def read_until(driver: Source, came: list[Chunk], done: Callable[[], bool]) -> None:
    def read() -> None:
        chunk = driver.read(0.1)
        if chunk is not None:
            came.append(chunk)

    until(done, meanwhile=read)


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["realtime", "dataset"])
def test_it_stays_stable_at_the_ends_of_its_range(profile: str) -> None:
    """Commands in quick succession, against an object: loads stay those of whiskers."""
    url = f"whisking:mouse?pace=fast&profile={profile}&object=mug-1&position_mm=20,8,0"
    with open_source(url) as source:
        assert isinstance(source, WhiskingSource)
        for _, command in random_commands(7)[:25]:
            source.set_whisking(*dataclasses.astuple(command))
            for _ in range(9):
                chunk = source.read()
                assert chunk is not None and np.isfinite(chunk.values).all()
                assert np.abs(chunk.values[..., :3]).max() < 0.1
