"""Configurations: what is right is read whole, what is wrong is refused in one golden line."""

import json
import os
import string
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import find_lines
from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.config import EXAMPLE, Config, config_text
from tactile_rt.daemon.loading import load_config
from tactile_rt.testing import small_spec
from tests.helpers.refusals import refusal

DATA = Path(__file__).parent / "data"
BROKEN = sorted(p.name for p in DATA.glob("*.toml"))
SMALL = 'version = 1\n[[source]]\nname = "whiskers"\nurl = "synthetic:5x6"\n'


def load(folder, text, *sets, name="robot.toml"):
    file = folder / name
    file.write_text(text)
    return load_config(file, sets)


def refusal_of(folder, text, *sets):
    return refusal(lambda: check_config(load(folder, text, *sets))).removeprefix(f"{folder}/")


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_refused_by_its_golden_message(name, monkeypatch):
    monkeypatch.chdir(DATA)
    golden = (DATA / name).read_bytes().split(b"\n")[0].decode().removeprefix("# ")
    said = refusal(lambda: check_config(load_config(Path(name))))
    assert said.replace(str(DATA), "HERE") == golden


def test_the_corpus_is_all_there():
    assert len(BROKEN) >= 129


def test_a_folder_a_pipe_and_what_is_too_large_are_no_configuration(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, why in ((tmp_path, "Is a directory"), (tmp_path / "pipe", "a pipe")):
        with pytest.raises(ConfigError, match=f"cannot be read: {why}"):
            load_config(path)
    with pytest.raises(ConfigError, match="larger than 1 MB"):
        load(tmp_path, "#" * (1 << 20) + "\n")


def test_the_example_is_right_and_shows_the_defaults(tmp_path):
    loaded = load(tmp_path, EXAMPLE)
    check_config(loaded)
    # What is commented out is as right as what is not.
    named = ("calibration", "array", "file")  # of files that are not there
    lines = [line.removeprefix("# ") for line in EXAMPLE.splitlines()[2:]]
    whole = "\n".join(line for line in lines if not line.startswith(named))
    full = load(tmp_path, whole)
    assert full.config.model[0].source == "whiskers"
    for table in ("recorder", "page", "metrics", "log", "limits"):
        shown = getattr(full.config, table)
        needed = {"folder": shown.folder} if table == "recorder" else {}
        assert shown == type(shown)(**needed), f"{table}: the example does not show the defaults"


def test_names_that_are_left_out_are_filled_in(tmp_path):
    config = load(tmp_path, SMALL + "[[model]]\n" * 2 + '[[publisher]]\nkind="jsonl"\n' * 2).config
    assert [m.name for m in config.model] == ["whiskers", "whiskers-2"]
    assert [m.source for m in config.model] == ["whiskers", "whiskers"]
    assert [p.name for p in config.publisher] == ["jsonl", "jsonl-2"]


def test_paths_are_meant_from_the_folder_of_the_file_that_they_stand_in(tmp_path, monkeypatch):
    (tmp_path / "base").mkdir()
    (tmp_path / "cell.toml").write_text("")
    monkeypatch.chdir(tmp_path / "base")
    config = load(
        tmp_path,
        SMALL + 'calibration = "cell.toml"\n[recorder]\nfolder = "rec"\n[[model]]\n'
        'file = "m.onnx"\n[log]\nfile = "log.txt"\n'
        '[[source]]\nname = "old"\nurl = "replay:run.mcap?speed=0"\n[[publisher]]\nkind = "jsonl"\n'
        'options = { file = "out.jsonl" }\n',
        "model.0.source=whiskers",
        "recorder.folder=set",
    ).config
    assert config.source[0].calibration == f"{tmp_path}/cell.toml"
    assert config.model[0].file == f"{tmp_path}/m.onnx"
    assert config.log.file == f"{tmp_path}/log.txt"
    assert config.source[1].url == f"replay:{tmp_path}/run.mcap?speed=0"
    assert config.publisher[0].options == {"file": f"{tmp_path}/out.jsonl"}
    assert config.recorder.folder == f"{tmp_path}/base/set"  # of the command line: from here


def test_a_calibration_that_is_no_file_is_a_devices_name(tmp_path):
    config = load(tmp_path, SMALL + 'calibration = "cell-3"\n').config
    assert config.source[0].calibration == "cell-3"


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("page.port", "--set page.port: a setting must be KEY=VALUE"),
        ("page..port=1", "--set page..port=1: a setting must be KEY=VALUE"),
        (
            "source.wiskers.url=x",
            "--set source.wiskers.url=x: no source 'wiskers'; did you mean whiskers?",
        ),
        ("page.prot=1", "--set page.prot=1: page has no key 'prot'; did you mean port?"),
        ("page.port=x", "--set page.port=x: page.port: expected a whole number, got 'x'"),
        ("version.a=1", "--set version.a=1: version has a value, not keys"),
        (
            "source.whiskers=1",
            "--set source.whiskers=1: source[0] is a table: name one of its keys",
        ),
        ("version=2", "--set version=2: version 2; this release reads 1"),
    ],
)
def test_a_wrong_setting_is_refused(tmp_path, setting, message):
    assert refusal_of(tmp_path, SMALL, setting) == message


@pytest.mark.parametrize("steps", [4, 40])
def test_how_many_steps_there_are_is_the_models_affair(tmp_path, steps):
    pytest.importorskip("onnx")
    from tests.helpers.tiny_model import write_model

    write_model(tmp_path / "m.onnx", steps=steps)
    table = SMALL.replace("synthetic:5x6", "serial:/dev/none?codec=native")  # of any array
    table += '[[model]]\nfile = "m.onnx"\nmode = "sliding"\nevery = {}\nin_a_row = {}\n'
    check_config(load(tmp_path, table.format(steps, steps)))
    said = f"expected a whole number <= {steps}, the steps that m.onnx has, got {steps + 1}"
    for key, values in (("every", (steps + 1, 1)), ("in_a_row", (1, steps + 1))):
        found = refusal_of(tmp_path, table.format(*values))
        assert found.endswith(f": model[0].{key}: {said}")
        setting = f"model.0.{key}={steps + 1}"
        found = refusal_of(tmp_path, table.format(1, 1), setting)
        assert found == f"--set {setting}: model[0].{key}: {said}"


@pytest.mark.parametrize(
    "url",
    [
        "serial:/dev/none?codec=bota",
        "serial:/dev/none?codec=ascii_line&columns=A0.fx,A0.fy",
        "can:virtual:none?codec=xela",
        "can:virtual:none?codec=icub_skin",
        "synthetic:30x6",
        "sim:rat",
        "whisking:mouse",
        "combined:head.toml",
    ],
)
def test_a_model_that_cannot_fit_its_source_is_refused_beforehand(tmp_path, monkeypatch, url):
    """Wherever the array is known without the device; with what differs, and what to do."""
    if url.startswith(("sim:", "whisking:")):
        pytest.importorskip("mujoco")
    (tmp_path / "head.toml").write_text(
        'name = "head"\nrate_hz = 100\n[[source]]\nname = "l"\nurl = "synthetic:2x6"\n'
    )
    found = refusal_of(tmp_path, SMALL.replace("synthetic:5x6", url) + "[[model]]\n")
    assert found.startswith("robot.toml:5: model[0].file: source whiskers: ")
    assert "mouse13.onnx was made for another array than" in found
    assert "; name a model of it" in found


def test_so_is_one_of_another_array_than_a_recording(tmp_path):
    for extra in ("mcap", "onnx"):
        pytest.importorskip(extra)
    from tests.helpers.tiny_model import write_model

    write_model(tmp_path / "m.onnx")
    played = SMALL.replace("synthetic:5x6", f"replay:{shipped_model().with_name('demo.mcap')}")
    check_config(load(tmp_path, played + "[[model]]\n"))
    found = refusal_of(tmp_path, played + '[[model]]\nfile = "m.onnx"\n')
    assert "m.onnx was made for another array than 'mouse-right'" in found


def test_a_model_is_held_against_what_its_source_is_said_to_be(tmp_path):
    (tmp_path / "mouse.onnx").symlink_to(shipped_model())
    line = SMALL.replace("5x6", "30x6") + "{}[[model]]\n"
    declaration = 'array = "mouse.onnx"\n'
    check_config(load(tmp_path, line.format(declaration)))
    found = refusal_of(tmp_path, line.format(""))
    assert found.endswith(f"or declare it as the model's: array={shipped_model()}")
    for unknown in ("serial:/dev/none?codec=native", "can:virtual:none?codec=native"):
        check_config(load(tmp_path, line.replace("synthetic:30x6", unknown).format("")))
    # of a device that only itself can tell, what it is said to be counts
    (tmp_path / "three.json").write_text(small_spec().to_json())
    told = line.replace("synthetic:30x6", "serial:/dev/none?codec=native")
    found = refusal_of(tmp_path, told.format('array = "three.json"\n'))
    assert "was made for another array than 'small'" in found


def test_what_is_shown_says_the_same_but_for_secrets(tmp_path):
    loaded = load(
        tmp_path,
        SMALL + '[[publisher]]\nkind = "jsonl"\noptions = { file = "a \\"b\\"\\u007f.jsonl" }\n'
        '[recorder]\nfolder = "r"\nrotate_s = 1e5\n[page]\ntoken = "0123456789abcdef"\n[[model]]\n',
    )
    shown = config_text(loaded.config)
    assert "0123456789abcdef" not in shown and 'token = "***"' in shown
    again = load(tmp_path, shown, "page.token=0123456789abcdef", name="again.toml")
    assert again.config == loaded.config


def test_lines_are_found_in_a_file_that_makes_it_hard():
    text = (
        'a = 1\n"b c".d = [ # [x]\n  "]", \'"\',\n]\n[t]\nx = """\n[no]\ny = 1 \\"""\n"""\n'
        "z = {k = ']'}\n[[l]]\n[[l.m]]\nq=1\n[[l.m]]\nq = 2\n[l.n]\nr = 1\n[[l]]\n"
    )
    lines = find_lines(text)
    assert lines[("a",)] == 1 and lines[("b c", "d")] == 2
    assert lines[("t",)] == 5 and lines[("t", "x")] == 6 and lines[("t", "z")] == 10
    assert lines[("l", 0)] == 11 and lines[("l", 0, "m", 0, "q")] == 13
    assert lines[("l", 0, "m", 1, "q")] == 15 and lines[("l", 0, "n", "r")] == 17
    assert lines[("l", 1)] == 18
    assert not any("no" in path or "y" in path for path in lines)


@pytest.mark.parametrize(
    "tables",
    [
        '[page]\nhost = "::1"\n[metrics]\nport = 8765\n',  # another address
        '[page]\nport = 9464\n[metrics]\nhost = "::1"\n',
        '[[publisher]]\nkind = "zmq"\noptions = {bind = "tcp://127.0.0.1:*"}\n' * 2,
        '[[publisher]]\nkind = "foxglove"\noptions = {port = 0}\n' * 2,
        '[[publisher]]\nkind = "jsonl"\n[[publisher]]\nkind = "jsonl"\noptions = {file = "a"}\n',
        '[metrics]\nhost = "robot-1.local"\n',
        '[page]\nhost = "fe80::1%eth0"\ntoken = "0123456789abcdef"\n',
        "",
    ],
)
def test_what_looks_alike_and_disturbs_nobody_is_right(tmp_path, tables):
    check_config(load(tmp_path, SMALL + tables))
    check_config(load(tmp_path, "\ufeff" + SMALL + tables))  # as Windows' editor writes it


@pytest.mark.parametrize("host", ["localhost", "0.0.0.0", "127.0.0.1"])
def test_one_port_of_one_address_however_it_is_written(tmp_path, host):
    text = f'[page]\nport = 9464\n[metrics]\nhost = "{host}"\n'
    assert "is where page listens" in refusal_of(tmp_path, SMALL + text)


def tables(of=Config):
    """TOML text of tables with right and wrong keys and values."""
    tables = ("source", "model", "publisher", "recorder", "page", "metrics", "log", "limits", "x")
    keys = (
        "version name url calibration file source decisions kind options folder rotate_mb "
        "rotate_s min_free_mb sync_s mode before_s after_s host port token control level format "
        "repeat_s "
        "queue_items queue_mb gather_ms stop_s stall_s retry_first_s samples state_s a.b 'c'"
    ).split()
    text = st.text(st.characters(blacklist_categories=("Cs",)), max_size=12).map(quoted)
    value = st.recursive(
        st.one_of(
            st.integers(-(10**25), 10**25).map(str),
            st.floats().map(repr),
            st.sampled_from(
                ["true", "false", '"synthetic:5x6"', '"serial:/dev/null?codec=native"', '"jsonl"',
                 '"always"', '"robot.toml"', '"~nobody/x"', "1979-05-27", "07:32:00", '"\\u0000"',
                 '"whiskers"', "0x10", "1_000", '"replay:x?%00=1"', '"can:slcan:?codec=native"']
            ),
            text,
        ),
        lambda inner: st.one_of(
            st.lists(inner, max_size=3).map(lambda xs: f"[{', '.join(xs)}]"),
            st.dictionaries(st.sampled_from(keys[:-2]), inner, max_size=3).map(
                lambda d: "{" + ", ".join(f"{k} = {v}" for k, v in d.items()) + "}"
            ),
        ),
        max_leaves=4,
    )  # fmt: skip
    pairs = st.dictionaries(st.sampled_from(keys), value, max_size=4).map(
        lambda d: "".join(f"{k} = {v}\n" for k, v in d.items())
    )
    header = st.sampled_from([f"[{t}]\n" for t in tables] + [f"[[{t}]]\n" for t in tables])
    return st.tuples(
        st.sampled_from(["version = 1\n", SMALL, ""]),
        st.lists(st.tuples(header, pairs).map("".join), max_size=4).map("".join),
    ).map("".join)


def quoted(text):
    return json.dumps(text).replace("\x7f", "\\u007f")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@settings(max_examples=400)
@given(
    text=tables(),
    sets=st.lists(
        st.tuples(
            st.sampled_from(
                ["page.port", "source.whiskers.url", "source.0.name", "a.b.c", "version", "source",
                 "log.level", "model.x.y", "", ".", "publisher.jsonl.options"]
            ),
            st.text(string.printable, max_size=8),
        ).map("=".join),
        max_size=2,
    ),
)  # fmt: skip
def test_no_configuration_raises_anything_but_a_clear_error(folder, text, sets):
    try:
        loaded = load(folder, text, *sets)
        check_config(loaded)
    except ConfigError as error:
        assert str(error) and "Traceback" not in str(error)
    else:
        assert load(folder, config_text(loaded.config)).config.source == loaded.config.source
