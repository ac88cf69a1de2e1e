"""The board: what stands in it, as a file and as a page."""

from importlib import metadata
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from tactile_rt.alignment import board as boards
from tactile_rt.alignment.board import (
    ANOTHER,
    BoardRow,
    compute_board,
    join_boards,
    traces_of,
    traces_of_stimuli,
)
from tactile_rt.alignment.board_page import board_page
from tactile_rt.alignment.datasets import DATASETS, dataset_names, find_dataset
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.metrics import find_metric
from tactile_rt.alignment.metrics.rsa_cka import NOTHING
from tactile_rt.alignment.stimuli_input import read_stimuli
from tactile_rt.core.errors import ConfigError
from tests.helpers import brains
from tests.helpers.pages import check_page

METRICS = ("rsa", "cka")


@pytest.fixture(scope="module")
def made():
    """A board of three rows, its animals, and its layers."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(6, 6, 8))
    animals = brains.courses(rng, features, 4, units=30)
    layers = {
        "encoder.good": features @ rng.normal(size=(8, 300)),
        "encoder.noise": rng.normal(size=(6, 6, 40)),
        "encoder.dead": np.ones((6, 6, 40)),
    }
    rows = [
        (BoardRow("model <1>", "model", "ab" * 32, 1234, ("a note",)), layers),
        (BoardRow("untrained, seed 0", "untrained"), {"encoder.dead": layers["encoder.dead"]}),
        (BoardRow("raw sensor input", "input"), {"raw": layers["encoder.noise"]}),
    ]
    dataset = find_dataset("example")
    board = compute_board(rows, dataset, animals, ("all", "L4"), METRICS, ("left out: x",))
    return board, animals, layers


def test_a_cell_is_the_mean_of_the_layer_chosen_on_other_animals(made):
    board, animals, layers = made
    cell = board.cells[0][0]
    measures = [find_metric("rsa")(animal) for animal in animals]
    wanted = [m.fit(layers["encoder.good"]) / m.ceiling for m in measures]
    assert cell.layer == "encoder.good"
    assert cell.score == pytest.approx(np.mean(wanted), abs=1e-12)
    assert cell.sem == pytest.approx(np.std(wanted, ddof=1) / 2, abs=1e-12)
    assert cell.value == pytest.approx(np.mean([m.fit(layers["encoder.good"]) for m in measures]))
    assert board.columns[0].ceiling == pytest.approx(np.mean([m.ceiling for m in measures]))


def test_one_thread_measures_whatever_others_use(made, monkeypatch):
    threadpoolctl = pytest.importorskip("threadpoolctl")
    seen = []

    def metric(animal):
        seen.extend(pool["num_threads"] for pool in threadpoolctl.threadpool_info())
        return NOTHING

    monkeypatch.setattr(boards, "find_metric", lambda name: metric)
    with threadpoolctl.threadpool_limits(2):
        compute_board([], find_dataset("example"), made[1], ("all",), ("mine",))
    assert seen and set(seen) == {1}


def test_another_animal_stands_below(made):
    board, animals, _ = made
    assert board.rows[-1] == BoardRow(ANOTHER, "animal")
    measures = [find_metric("rsa")(animal) for animal in animals]
    means = []
    for animal in animals:
        each = [[s.rates[s.stimulus == k].mean(0) for k in range(6)] for s in animal.sessions]
        means.append(np.concatenate(each, axis=1)[:, None])
    wanted = [
        np.mean([m.fit(x) for j, x in enumerate(means) if j != i]) / m.ceiling
        for i, m in enumerate(measures)
    ]
    assert board.cells[3][0].score == pytest.approx(np.mean(wanted), abs=1e-9)


def test_what_cannot_be_had_is_empty(made):
    board, _, _ = made
    assert np.isnan(board.cells[1][0].score), "a dead layer"
    assert [c.part for c in board.columns] == ["all", "all", "L4", "L4"]
    assert board.columns[2].animals == 0 and np.isnan(board.columns[2].ceiling)
    assert all(np.isnan(board.cells[r][2].score) for r in range(4))


def test_boards_stand_side_by_side(made):
    board = made[0]
    both = join_boards([board, board])
    assert len(both.columns) == 8 and len(both.datasets) == 2
    assert both.cells[0] == board.cells[0] * 2


def test_the_page_stands_alone_and_says_everything(made):
    board = made[0]
    text = board_page(board)
    check_page(text)
    assert "model &lt;1&gt;" in text and "model <1>" not in text
    for said in ("another animal", "raw sensor input", "a note", "left out: x", "1,234 parameters",
                 "What this cannot say", "encoder.good",
                 f"<b>{board.cells[0][0].score:.2f}</b>"):  # fmt: skip
        assert said in text, said


def test_layers_as_metrics_take_them():
    trace = np.arange(6 * 4 * 2, dtype=np.float32).reshape(6, 4, 2)
    layers = Layers("m", {"a": trace, "b": trace[:, :1]}, {"a": 2, "b": 0}, trace, 0)
    traces = traces_of(layers)
    assert np.isnan(traces["a"][:, :2]).all()
    np.testing.assert_array_equal(traces["a"][:, 2:], trace[:, 2:])
    np.testing.assert_array_equal(traces["b"], trace[:, :1].repeat(22, axis=1))
    felt = read_stimuli()
    raw = traces_of_stimuli(felt)["raw"]
    np.testing.assert_allclose(raw.mean(axis=1), felt.raw(), rtol=1e-6)


def test_datasets_say_where_they_come_from(monkeypatch):
    for name in dataset_names():
        one = find_dataset(name)
        assert one.name == name
        assert one.title and one.citation and one.size and one.about
        if one.url:
            assert one.license in ("CC0-1.0", "CC-BY-4.0") and one.url in one.citation
    with pytest.raises(ConfigError, match="no dataset '00231'; did you mean 000231"):
        find_dataset("00231")

    where, group = DATASETS["example"], "tactile_rt.alignment_datasets"
    points = EntryPoint("mine", where, group), EntryPoint("lost", "no_such_module:x", group)
    monkeypatch.setattr(metadata, "entry_points", lambda group: EntryPoints(points))
    assert dataset_names() == (*DATASETS, "lost", "mine")
    assert find_dataset("mine") is find_dataset("example")
    with pytest.raises(ConfigError, match="dataset lost cannot be loaded: No module named"):
        find_dataset("lost")
