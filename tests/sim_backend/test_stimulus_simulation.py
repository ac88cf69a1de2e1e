"""The stimuli: their surface against the analytic arc, what they are, and the files written."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI
from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.stimulus_simulation import (
    PERIOD_NS,
    Surface,
    Touch,
    model_input,
    whisk_against,
    write_input,
)
from tactile_rt.sim_backend.trajectories import Whisk
from tactile_rt.sim_backend.whisking import WhiskSimulation
from tactile_rt.sim_backend.world import OBJECT_BIT, PROFILES, array_spec

MOUSE = {w.name: w for w in mouse_whiskers()}


def world_of(pieces):
    """The surface alone, as MuJoCo collides it."""
    spec = mujoco.MjSpec()
    for i, points in enumerate(pieces):
        spec.add_mesh(name=f"{i}", uservert=points.astype(np.float32).ravel())
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{i}", contype=OBJECT_BIT, group=2
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def distance_along(model, data, start, way):
    hit = np.zeros(1, dtype=np.int32)
    return mujoco.mj_ray(model, data, start, way, None, 1, -1, hit, np.zeros(3))


# ---- the surface


@pytest.mark.parametrize("name", STIMULI)
def test_the_face_is_the_analytic_arc(name):
    """Rays against the circle, written here from its centre and radius alone."""
    surface = Surface.make(name)
    model, data = world_of(surface.pieces())
    turn = np.radians(surface.facing_deg)
    out = np.array([np.cos(turn), np.sin(turn), 0])
    side = np.array([-np.sin(turn), np.cos(turn), 0])
    at = np.array(surface.position_mm)
    # Centre of the circle: behind a convex face, in front of a concave one.
    centre = at + out * surface.radius_mm * (-1 if surface.shape == "convex" else 1)
    worst = 0.0
    for v in np.linspace(-25.3, 25.3, 101):
        for z in (-8.5, 0.0, 8.5):
            start = at + 30 * out + v * side + [0, 0, z]
            d = distance_along(model, data, start, -out)
            assert d > 0, (v, z)
            p = start - d * out
            worst = max(worst, abs(np.hypot(*(p - centre)[:2]) - surface.radius_mm))
    assert worst <= 0.1
    assert worst <= surface.largest_gap_mm + 1e-3
    # And it ends where it should.
    for v, z in ((25.6, 0.0), (-25.6, 0.0), (0.0, 8.9), (0.0, -8.9)):
        assert distance_along(model, data, at + 30 * out + v * side + [0, 0, z], -out) < 0


def test_concave_stays_concave():
    """A small ball rests in the hollow's middle, which a hull would have filled."""
    surface = Surface.make("concave-close")
    sagitta = surface.radius_mm - np.sqrt(surface.radius_mm**2 - (surface.chord_mm / 2) ** 2)
    assert sagitta == pytest.approx(5.30, abs=0.02)  # of the published mesh, at its scale
    turn = np.radians(surface.facing_deg)
    out = np.array([np.cos(turn), np.sin(turn), 0])
    for pieces, filled in ((surface.pieces(), False), ((np.concatenate(surface.pieces()),), True)):
        model, data = world_of(pieces)
        d = distance_along(model, data, np.array(surface.position_mm) + 30 * out, -out)
        assert d == pytest.approx(30 - sagitta if filled else 30, abs=0.05)


def test_distances_go_away_from_the_array_in_steps():
    for shape in ("convex", "concave"):
        named = (Surface.make(f"{shape}-{d}") for d in ("close", "medium", "far"))
        at = [np.array(surface.position_mm) for surface in named]
        np.testing.assert_allclose(at[1] - at[0], [1, 1, 0])
        np.testing.assert_allclose(at[2] - at[1], [1, 1, 0])
        normal = np.radians(Surface.make(f"{shape}-far").facing_deg)
        assert (at[0] - at[1]) @ [np.cos(normal), np.sin(normal), 0] > 1.3
    further = Surface.make("convex-far", step_mm=(2.0, 1.5, 0.5))
    np.testing.assert_allclose(
        np.array(further.position_mm) - Surface.make("convex-close").position_mm, [4, 3, 1]
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shape": "flat"}, "no shape 'flat'"),
        ({"radius_mm": 0.0}, "radius_mm must be positive"),
        ({"radius_mm": 20.0}, "too wide for an arc"),
    ],
)
def test_impossible_surfaces_are_refused(change, said):
    with pytest.raises(ConfigError, match=said):
        dataclasses.replace(Surface.make("convex-far"), **change)


def test_unknown_stimuli_are_refused():
    with pytest.raises(ConfigError, match=r"no stimulus 'convex-near': there are convex-close, "):
        Surface.make("convex-near")


# ---- whisking against it


def test_closer_is_touched_earlier_and_by_more():
    """A caudal, a middle and a rostral whisker of three rows, at the real-time profile."""
    some = tuple(MOUSE[n] for n in ("C0", "C1", "D0", "D1", "D2", "D3", "E0", "E1", "A2", "C6"))
    felt = {}
    for name in STIMULI:
        simulation = WhiskSimulation(
            some, Whisk(duration_s=0.24), PROFILES["realtime"], Surface.make(name).pieces()
        )
        felt[name] = whisk_against(simulation)
    for shape in ("convex", "concave"):
        first = [felt[f"{shape}-{d}"].first_ms for d in ("close", "medium", "far")]
        count = [felt[f"{shape}-{d}"].touch.any(axis=0).sum() for d in ("close", "medium", "far")]
        assert first == sorted(set(first))
        assert count == sorted(set(count), reverse=True)
        assert count[0] >= 7
    # Too short, dorsal or rostral.
    assert not any(f.touch[:, -2:].any() for f in felt.values())


# ---- the model's input


def made_up(first, length=1400, elements=3):
    """A ramp that begins with the contact."""
    rng = np.random.default_rng(first)
    loads = np.zeros((length, elements, 6), dtype=np.float32)
    touch = np.zeros((length, elements), dtype=bool)
    loads[first:, 1] = rng.normal(size=(length - first, 6)) * 1e-4
    touch[first::7, 1] = True
    return Touch(loads, touch)


def test_the_window_begins_with_the_contact():
    felt = made_up(123)
    values = model_input(felt)
    assert values.shape == (110, 3, 6)
    # A Hann kernel of 9 ms either side, centred on the contact and every 9 ms from there.
    offset = np.arange(-8, 9)
    weight = 1 + np.cos(np.pi * offset / 9)
    for k in (0, 1, 57, 109):
        window = felt.loads[123 + 9 * k + offset, 1].astype(float)
        want = weight @ window / weight.sum()
        np.testing.assert_allclose(values[k, 1], want, rtol=1e-5, atol=1e-11)
    assert not values[:, [0, 2]].any()


NOTHING = Touch(np.zeros((1400, 3, 6), np.float32), np.zeros((1400, 3), bool))


@pytest.mark.parametrize(
    ("felt", "said"),
    [
        (NOTHING, "no whisker touches"),
        (made_up(500), "must last 1491 ms or more, not 1400 ms"),
        (made_up(4), "begin 9 ms or more before the contact"),
    ],
)
def test_windows_that_cannot_be_had(felt, said):
    with pytest.raises(ConfigError, match=said):
        model_input(felt)


def test_the_files_say_all(tmp_path):
    whiskers = (MOUSE["C1"], MOUSE["C2"], MOUSE["D1"])
    felt = {"convex-close": made_up(50), "concave-far": made_up(80)}
    out = tmp_path / "input.npz"
    spec = array_spec(whiskers, "some")
    angles = np.zeros((1400, 3, 3))
    write_input(out, felt, spec, angles, {"head": {"position": [0, 0, 0]}})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["input.json", "input.npz"]
    with np.load(out) as arrays:
        assert arrays["stimuli"].tolist() == list(felt)
        assert arrays["values"].shape == (2, 110, 3, 6)
        assert arrays["values"].dtype == np.float32
        np.testing.assert_array_equal(arrays["values"][1], model_input(felt["concave-far"]))
        assert arrays["values_1khz"].shape == (2, 1400, 3, 6)
        assert arrays["touch"].shape == (2, 1400, 3)
        assert arrays["angles"].shape == (1400, 3, 3)
        assert arrays["first_contact_ms"].tolist() == [50, 80]
        assert arrays["elements"].tolist() == ["C1", "C2", "D1"]
        assert arrays["units"].tolist() == ["N"] * 3 + ["N m"] * 3
    described = json.loads(out.with_suffix(".json").read_text())
    assert described["stimuli"] == list(felt)
    assert described["touched"] == {n: ["C2"] for n in felt}
    assert described["period_ns"] == PERIOD_NS == 9_000_000
    assert set(described["versions"]) == {"tactile_rt", "mujoco", "numpy"}
    before = described["sha256_of_values"]
    write_input(out, felt, spec, angles, {})
    assert json.loads(out.with_suffix(".json").read_text())["sha256_of_values"] == before


def test_nothing_is_written_for_what_is_not_touched(tmp_path):
    felt = {"convex-close": made_up(50), "concave-far": made_up(600)}
    spec = array_spec((MOUSE["C1"], MOUSE["C2"], MOUSE["D1"]), "some")
    with pytest.raises(ConfigError, match=r"^concave-far: first contact is at 600 ms"):
        write_input(tmp_path / "input.npz", felt, spec, np.zeros((1, 3, 3)), {})
    assert not list(tmp_path.iterdir())
