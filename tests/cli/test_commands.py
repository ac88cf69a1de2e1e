"""All commands alike: their tables and figures as JSON, and one name for one thing."""

import io
import json
import os
import re
import sys
from collections import defaultdict
from pathlib import Path

import msgspec
import numpy as np
import pytest
from matplotlib.image import imread

from tactile_rt import cli
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.daemon.messages import StateMessage
from tests.cli.test_top import busy_snapshot
from tests.helpers.commands import commands, options_of
from tests.helpers.processes import run_program
from tests.helpers.source_tree import ROOT

# Those that print neither a table nor figures, and what they do instead. Whoever adds a command
# gives it --json, or a line here.
NO_FIGURES = {
    "align example": "writes recordings",
    "align report": "writes a page",
    "config alerts": "prints rules of Prometheus",
    "config check": "says that all is right",
    "config example": "prints TOML",
    "config ros2-messages": "writes a package",
    "config show": "prints TOML",
    "describe": "prints JSON",
    "dump": "prints bytes",
    "echo": "prints JSON",
    "emulate": "is a device",
    "install-service": "writes scripts",
    "new": "writes a project",
    "replay": "prints JSON",
    "run": "prints JSON",
    "view": "draws",
}
# Options that are text in some commands and a file in others.
OF_TWO_KINDS = {
    "--array": "a name or a file; of `array fit` a file alone",
    "--data": "a sweep set; of `align board` DATASET=PATH",
    "--model": "a file; of `teach` also `shipped`",
}
MOST_NAMES = 105  # of options, over all commands: fewer are easier to remember
MODEL = shipped_model()


def test_every_command_that_tells_figures_tells_them_as_json():
    every = commands()
    assert NO_FIGURES.keys() <= every.keys()
    without = {name for name, command in every.items() if "--json" not in options_of(command)}
    assert without == NO_FIGURES.keys()


def test_no_table_is_printed_but_by_what_fits_it_to_where_it_goes():
    for path in Path(cli.__file__).parent.glob("*.py"):
        if path.name != "tables.py":
            assert not re.search(r"(?<!_)print\(_?table", path.read_text("utf-8")), path


def test_an_option_takes_the_same_in_every_command():
    kinds = defaultdict(set)
    for command in commands().values():
        for name, option in options_of(command).items():
            kinds[name].add(option.type.name.removesuffix(" range"))
    assert {name for name, found in kinds.items() if len(found) > 1} <= OF_TWO_KINDS.keys()


def test_options_have_few_names():
    every = commands().values()
    names = {n for command in every for n in options_of(command)}
    negated = {n for command in every for p in command.params for n in p.secondary_opts}
    assert len(names | negated) <= MOST_NAMES


def test_every_option_and_argument_says_what_it_is():
    for name, command in commands().items():
        assert command.help, name
        for parameter in command.params:
            assert parameter.help or parameter.name == "help", (name, parameter.name)


@pytest.fixture
def narrow(monkeypatch):
    """Call a command as on a terminal of 40 columns."""

    def begin(call, *words):
        with monkeypatch.context() as patch:
            for name, value in (("COLUMNS", "40"), ("FORCE_COLOR", "1"), ("NO_COLOR", "1")):
                patch.setenv(name, value)
            return call(*words)

    return begin


TABLES = [
    ("align", "datasets"), ("array", "list"), ("codecs",), ("codecs", "xela"), ("list",),
    ("model", "show", MODEL), ("recipes",), ("doctor",),
    ("hil", "--source", "sim:mouse?objects=mug-1&seed=2", "--sweeps", 1),
    ("sniff", "touches.bin"), ("tare", "synthetic:3x6", "--seconds", "0.1", "--out", "t.toml"),
    ("calibrate", "loads.csv"), ("top", "-", "--once"), ("align", "decode", MODEL),
]  # fmt: skip


@pytest.fixture
def at_work(cwd, monkeypatch):
    """A folder with what the commands above read."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(cwd))
    rows = ["fx,fy,raw_a,raw_b"]
    rows += [f"{x},{y},{2 * x + 0.1 * y},{3 * y}" for x in (0, 1, 2) for y in (0, 1, 3)]
    (cwd / "loads.csv").write_text("\n".join(rows))
    (cwd / "touches.bin").write_bytes(b"0.1,0.2,0.3\r\n" * 200)


@pytest.mark.parametrize("words", TABLES, ids=lambda words: " ".join(map(str, words[:2])))
def test_no_word_of_a_table_is_lost_in_a_pipe_or_at_forty_columns(
    call, narrow, at_work, monkeypatch, words
):
    _ready(words, monkeypatch)
    code, piped, err = call(*words)
    assert code in (0, 1), err
    assert "…" not in piped
    _ready(words, monkeypatch)
    same, shown, _ = narrow(call, *words)
    assert same == code
    assert "…" not in shown
    lines = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown)
    seen = "".join(lines.split())
    # Without rules and what changes from call to call.
    for word in re.sub(r"[\d.]+|[━─│┃┏┓┗┛┡┩└┘├┤┼┴┬┳╇]+", " ", piped).split():
        assert len(word) == 1 or word in seen, word


def _ready(words, monkeypatch):
    if words[0] in ("hil", "array"):
        pytest.importorskip("mujoco")
        pytest.importorskip("trimesh")
    if words[0] == "align":
        pytest.importorskip("sklearn")
    if words[0] == "top":
        line = msgspec.json.encode(StateMessage(t_ns=1, utc_ns=1, snapshot=busy_snapshot()))
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(line + b"\n")))


@pytest.mark.parametrize("words", TABLES, ids=lambda words: " ".join(map(str, words[:2])))
def test_json_to_stdout_is_alone_there(call, at_work, monkeypatch, words):
    _ready(words, monkeypatch)
    code, out, err = call(*words, "--json", "-")
    assert code in (0, 1), err
    json.loads(out)


@pytest.mark.parametrize("columns", ["40", "80", "100"])
def test_no_word_of_a_help_is_cut(columns):
    """In a process of its own: how wide a terminal is, is asked once."""
    program = (
        "import typer\n"
        "from tactile_rt.cli.app import app\n"
        "from tests.helpers.commands import commands\n"
        "every, program = commands(), typer.main.get_command(app)\n"
        "for name in every:\n"
        "    try:\n"
        "        program.main([*name.split(), '--help'], prog_name='tactile-rt')\n"
        "    except SystemExit:\n"
        "        pass\n"
    )
    narrow = {**os.environ, "COLUMNS": columns, "NO_COLOR": "1"}
    done = run_program(program=program, env=narrow, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "…" not in done.stdout
    if columns != "40":  # where a column of options leaves too little for some words
        assert [x for x in done.stdout.splitlines() if len(x) > int(columns)] == []


def test_recipes_draw_every_augmentation(call, tmp_path):
    code, _, err = call("recipes", "--plot", tmp_path / "augmentations.png")
    assert code == 0, err
    drawn = imread(tmp_path / "augmentations.png")[..., :3]
    rows = np.array_split(drawn[:, 200:].mean(axis=2), 7)  # without the names
    assert len({round(float(row.mean()), 6) for row in rows}) == 7
    assert call("recipes", "--plot", tmp_path / "a.txt")[0] == 2
