"""The contact network on a set whose answer is known in closed form: straight, stiff whiskers."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from sklearn.metrics import f1_score, roc_auc_score

from tactile_rt.classifier.contact_point import WhiskerShapes
from tactile_rt.errors import ConfigError
from tactile_rt.evidence.locating import (
    contact_records,
    weighted_auroc,
    weighted_quantile,
)
from tactile_rt.evidence.records import Record
from tactile_rt.models import contact_regression
from tactile_rt.models.contact_regression import (
    ContactConfig,
    ContactNetwork,
    load_contacts,
    predict_contacts,
    tared,
    train_contacts,
)
from tactile_rt.models.datasets import SweepSet
from tactile_rt.stream import ArraySpec
from tactile_rt.sweep_set import SPLITS, SweepManifest, write_object

SHAPES = WhiskerShapes(*(np.array(v) for v in (
    [0.02, 0.01, 0.005], [0.0] * 3, [5e-5, 4e-5, 3e-5], [5e-6] * 3, [5e9] * 3
)))  # fmt: skip
SPEC = ArraySpec(
    name="three",
    elements=("A0", "B0", "C0"),
    grid=((0, 0), (1, 0), (2, 0)),
    positions=((0.0, 0.0, 0.0),) * 3,
    orientations=((1.0, 0.0, 0.0, 0.0),) * 3,
    channels=("fx", "fy", "fz", "mx", "my", "mz"),
    units=("N",) * 3 + ("N m",) * 3,
    rate_hz=1000.0,
    frame="head",
)
LEAD, SAMPLES, SWEEPS = 6, 40, 12


def write_set(folder: Path, contacts: bool = True) -> Path:
    """Objects that slide along the whiskers and push across them, with some friction."""
    names = {split: tuple(f"mug-{3 * k + i}" for i in range(3)) for k, split in enumerate(SPLITS)}
    recipe = {"contacts": True} if contacts else {}
    manifest = SweepManifest(SPEC, 9_000_000, LEAD, ("mug",), names, recipe)
    manifest.write(folder)
    for name in manifest.names():
        rng = np.random.default_rng(list(name.encode()))
        shape = (SWEEPS, SAMPLES, 3)
        t = np.arange(SAMPLES)[:, None]
        start, stop = rng.integers(LEAD, 20, (SWEEPS, 1, 3)), rng.integers(22, 40, (SWEEPS, 1, 3))
        touching = (t >= start) & (t < stop)
        share = rng.uniform(0.2, 0.9, (SWEEPS, 1, 3)) + rng.normal(0, 2e-3, shape) * t
        distance = np.clip(share, 0.05, 1) * SHAPES.length
        angle = rng.uniform(0, 2 * np.pi, (SWEEPS, 1, 3)) + np.zeros(shape)
        size = 10 ** rng.uniform(-5, -3, (SWEEPS, 1, 3)) * touching
        force = np.stack([0.3 * size, size * np.cos(angle), size * np.sin(angle)], axis=-1)
        at = np.stack([distance, np.zeros(shape), np.zeros(shape)], axis=-1)
        values = np.concatenate([force, np.cross(at, force)], axis=-1).astype(np.float32)
        truth = np.where(touching, distance, np.nan) if contacts else None
        write_object(folder, name, values, {}, truth)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("sets") / "with")


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    checkpoint = folder.parent / "locate.pt"
    train_contacts(
        SweepSet.read(folder, "train"),
        SweepSet.read(folder, "validation"),
        SHAPES,
        ContactConfig(hidden=16, epochs=12, batch=8, learning_rate=1e-2),
        checkpoint,
    )
    return checkpoint


def test_it_finds_touches_and_places_better_than_the_mean(folder: Path, trained: Path) -> None:
    test = SweepSet.read(folder, "test")
    touch, distance = predict_contacts(load_contacts(trained, test), tared(test))
    truth = test.sweeps.contacts
    assert truth is not None
    touching = np.isfinite(truth)
    assert roc_auc_score(touching.ravel(), touch.ravel()) > 0.97
    assert f1_score(touching.ravel(), touch.ravel() > 0.5) > 0.9
    share, known = (x[touching] for x in (distance / SHAPES.length, truth / SHAPES.length))
    middle = np.abs(known - known.mean()).mean()
    assert np.abs(share - known).mean() < 0.4 * middle
    noisy = predict_contacts(load_contacts(trained, test), tared(test, 1.0))[1]
    worse = np.abs(noisy / SHAPES.length - truth / SHAPES.length)[touching].mean()
    assert np.abs(share - known).mean() < worse < middle


def test_training_is_repeatable(folder: Path, tmp_path: Path) -> None:
    train, held = SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")
    first, second, other = (
        train_contacts(train, held, SHAPES, ContactConfig(8, 1, 64, seed=seed), tmp_path / "x.pt")
        for seed in (0, 0, 1)
    )
    a, b, c = (n.state_dict()["leave.0.weight"] for n in (first, second, other))
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_a_stream_step_by_step_is_the_whole(folder: Path, trained: Path) -> None:
    network, data = load_contacts(trained), SweepSet.read(folder, "test")
    felt, every = tared(data, 1.0), torch.arange(3)
    loads, sigma = (torch.from_numpy(x[0]) for x in (felt.loads, felt.sigma))
    loads = loads.transpose(0, 1)
    state, steps = None, []
    with torch.no_grad():
        whole = network(loads, sigma, every)
        for t in range(loads.shape[1]):
            touch, share, state = network(loads[:, t : t + 1], sigma, every, state)
            steps.append(torch.cat([touch, share], dim=1))
        later = loads.clone()
        later[:, 20:] += 1e-3
        assert torch.equal(network(later, sigma, every)[1][:, :20], whole[1][:, :20])
    together = torch.stack(steps, dim=1)
    assert torch.allclose(together[..., 0], whole[0], atol=1e-5)
    assert torch.allclose(together[..., 1], whole[1], atol=1e-6)


def test_the_tare_takes_an_offset_away(folder: Path) -> None:
    data = SweepSet.read(folder, "test")
    felt = tared(data, 1.0)
    quiet = felt.loads[:, :LEAD]
    assert np.abs(quiet.mean(axis=1)).max() < 1e-9
    noise = np.repeat([1e-5, 5e-8], 3)
    assert felt.sigma.mean(axis=(0, 1)) / noise == pytest.approx(0.95, abs=0.1)
    assert np.array_equal(tared(data).loads, data.sweeps.values)


def test_the_figures_hold_what_they_say(folder: Path, trained: Path) -> None:
    records = {r.name: r for r in contact_records(trained, folder)}
    assert all(np.isfinite(r.value) for r in records.values())
    # Straight and stiff: mechanics knows the answer, but for what "bent" makes of the stiffness.
    for who in ("straight", "resting"):
        assert records[f"contact.clean.{who}.all.p95"].value < 0.1
    network, middle = (
        records[f"contact.clean.{who}.all.median"].value for who in ("network", "middle")
    )
    assert 0.1 < network < 0.5 * middle
    assert records["contact.noisy.straight.all.median"].value > 1
    assert records["contact.clean.loads.auroc"].value == pytest.approx(1)
    assert "touches" in records["contact.noisy.network.felt.p95"].how


def test_weighted_figures_are_those_of_repeated_samples() -> None:
    rng = np.random.default_rng(0)
    score = np.round(rng.normal(size=200), 1).astype(np.float32)
    true = rng.random(200) < 0.3 + 0.3 * (score > 0)
    weights = rng.integers(0, 4, (3, 200)).astype(float)
    for w, area, middle in zip(
        weights,
        weighted_auroc(score, true, weights),
        weighted_quantile(score.astype(float), weights, 0.5),
        strict=True,
    ):
        times = w.astype(int)
        repeated = np.repeat(score, times)
        assert area == pytest.approx(roc_auc_score(np.repeat(true, times), repeated))
        assert middle == np.quantile(repeated.astype(float), 0.5, method="inverted_cdf")


def touched_once(data: SweepSet, times: int = 1) -> SweepSet:
    """The sweeps, of which one whisker of one is touched, in so many samples."""
    contacts = np.full_like(data.sweeps.contacts, np.nan)
    contacts[0, LEAD : LEAD + times, 0] = 0.01
    return replace(data, sweeps=replace(data.sweeps, contacts=contacts))


def test_it_learns_from_a_single_touch(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact_regression, "UNTOUCHED", 0.0)
    train, held = SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")
    few = ContactConfig(8, 1, 64)
    train_contacts(touched_once(train), touched_once(held), SHAPES, few, tmp_path / "x.pt")
    assert (tmp_path / "x.pt").exists()


def test_where_nothing_touches_is_told(folder: Path, tmp_path: Path) -> None:
    train, held = SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")
    for split, one, other in (
        ("training", touched_once(train, 0), held),
        ("validation", train, touched_once(held, 0)),
    ):
        with pytest.raises(ConfigError, match=f"no whisker touches anything in the {split} split"):
            train_contacts(one, other, SHAPES, ContactConfig(8, 1), tmp_path / "x.pt")
    assert not (tmp_path / "x.pt").exists()


@pytest.mark.parametrize("batches", [1, 7, 8, 9])
def test_every_number_of_updates_has_a_schedule(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batches: int
) -> None:
    monkeypatch.setattr(contact_regression, "UNTOUCHED", 0.0)
    train, held = SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")
    touched = np.isfinite(train.sweeps.contacts).any(axis=1).sum()
    some = ContactConfig(4, 1, int(np.ceil(touched / batches)))
    train_contacts(train, held, SHAPES, some, tmp_path / "x.pt")


def test_a_draw_without_a_touch_tells_nothing() -> None:
    score, true = np.array([1.0, 2.0, 3.0], np.float32), np.array([True, False, False])
    weights = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    assert np.array_equal(
        weighted_auroc(score, true, weights), [0.0, np.nan, np.nan], equal_nan=True
    )
    errors = np.array([0.5, 0.7])
    found = weighted_quantile(errors, np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 2.0]]), 0.5)
    assert np.array_equal(found, [0.5, np.nan, 0.7], equal_nan=True)
    assert np.isnan(weighted_quantile(np.empty(0), np.empty((2, 0)), 0.5)).all()


def keep_touches(folder: Path, out: Path, kept: dict[str, int], force: float = 1.0) -> Path:
    """A copy of a set, of which some objects are touched in their first samples of all alone."""
    manifest = SweepManifest.read(folder)
    manifest.write(out)
    for name in manifest.names():
        with np.load(folder / f"{name}.npz") as arrays:
            values, contacts = arrays["values"] * np.float32(force), arrays["contacts"]
        touched = np.flatnonzero(np.isfinite(contacts))
        contacts.ravel()[touched[kept.get(name, len(touched)) :]] = np.nan
        write_object(out, name, values, {}, contacts)
    return out


def lowest(record: Record) -> float:
    """The lower end of a figure's interval."""
    return float(record.how.partition("[")[2].partition(",")[0])


def test_objects_that_are_not_touched_make_no_interval_lower(
    folder: Path, trained: Path, tmp_path: Path
) -> None:
    test = SweepManifest.read(folder).split["test"]
    two = keep_touches(folder, tmp_path / "two", dict.fromkeys(test[1:], 0))
    records = {r.name: r for r in contact_records(trained, two)}
    # All touches are of one object: whenever it is drawn, its errors are the same.
    for what in ("median", "p95"):
        figure = records[f"contact.clean.network.all.{what}"]
        assert lowest(figure) == pytest.approx(figure.value, rel=1e-3)
    assert lowest(records["contact.clean.network.f1"]) > 0
    assert np.isfinite(lowest(records["contact.clean.network.auroc"]))


def test_a_set_of_faint_touches_has_no_figures_of_felt_ones(
    folder: Path, trained: Path, tmp_path: Path
) -> None:
    faint = keep_touches(folder, tmp_path / "faint", {}, force=1e-6)
    names = {r.name for r in contact_records(trained, faint)}
    assert "contact.clean.network.all.median" in names
    assert not any(".felt." in name for name in names)


def test_one_object_has_figures_but_no_interval(folder: Path, trained: Path) -> None:
    whole = SweepManifest.read(folder)
    manifest = replace(whole, split={**whole.split, "test": whole.split["test"][:1]})
    (folder / "manifest.json").write_bytes(msgspec.json.encode(manifest))
    try:
        records = contact_records(trained, folder)
    finally:
        (folder / "manifest.json").write_bytes(msgspec.json.encode(whole))
    assert all(r.how.startswith("no interval: touches of one object; ") for r in records)
    assert all(r.how.count("no interval") == 1 for r in records)


def test_what_does_not_fit_is_told(folder: Path, trained: Path, tmp_path: Path) -> None:
    train, held = SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")
    two = WhiskerShapes(*(np.ones(2),) * 5)
    with pytest.raises(ConfigError, match="2 whisker shapes for a set of 3 whiskers"):
        train_contacts(train, held, two, ContactConfig(), tmp_path / "x.pt")
    plain = SweepSet.read(write_set(tmp_path / "plain", contacts=False), "train")
    with pytest.raises(ConfigError, match="holds no contacts"):
        train_contacts(plain, plain, SHAPES, ContactConfig(), tmp_path / "x.pt")
    assert not (tmp_path / "x.pt").exists()
    for wrong, said in (
        ({"hidden": 0}, "hidden must be positive, not 0"),
        ({"hidden": 10**9}, "hidden must be at most 1024, not 1000000000"),
        ({"learning_rate": float("nan")}, "learning_rate must be positive, not nan"),
        ({"learning_rate": float("inf")}, "learning_rate must be at most 1, not inf"),
        ({"seed": -1}, "seed must be 0 to 4294967295, not -1"),
        ({"seed": 2**70}, "seed must be 0 to 4294967295"),
    ):
        with pytest.raises(ConfigError, match=said):
            ContactConfig(**wrong)
    short = replace(train, manifest=replace(train.manifest, lead=1))
    with pytest.raises(ConfigError, match="a lead of 1 samples at rest, and the noise needs 2"):
        train_contacts(short, held, SHAPES, ContactConfig(), tmp_path / "x.pt")
    (tmp_path / "bad.pt").write_bytes(b"nothing")
    why = r"bad\.pt is no network of `tactile-rt locate train`: it is another file, or damaged$"
    with pytest.raises(ConfigError, match=why):
        load_contacts(tmp_path / "bad.pt")


def test_the_length_scales_the_distance() -> None:
    torch.manual_seed(0)
    network = ContactNetwork(SHAPES, 4)
    assert network.length.tolist() == pytest.approx(SHAPES.length.tolist())
    assert sum(p.numel() for p in network.parameters()) < 400
