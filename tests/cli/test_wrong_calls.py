"""Hundreds of wrong calls of all commands: each is one line on stderr, exit code 2, no traceback.

What is wrong is made from each command's own parameters: an option that there is not, an argument
too few or too many, text for a number, a number that is none or has no bounds, a file that is not
there, a folder, an empty file, junk, one that may not be read, and a place that cannot be written.
"""

import pytest

from tests.helpers.commands import commands, options_of

EVERY = commands()
# What a command answers wrong words with, where it is not 2, as its help says.
CODES = {"align gate": 3}
FILES = ("missing", "folder", "empty", "junk", "\u00fcn\u00efcode \U0001f9e4 [x]", "file/below")
# Commands that make something new of a name or a folder.
MAKES = {"align example", "config ros2-messages", "new", "sweep"}
SOURCES = (
    "", "nope:x", "serial:", "serial:/dev/none?codec=nope", "serial:/dev/none?codec=bota&boud=1",
    "synthetic:axb", "synthetic:5x6?rate_hz=nan", "replay:junk", "replay:folder", "can:",
    "combined:junk", "\U0001f9e4", "x" * 5000,
)  # fmt: skip
HEARS = {"describe": [], "echo": [], "hz": [], "record": ["run.mcap"], "tare": [], "teach": ["a"]}


@pytest.fixture
def place(cwd, monkeypatch):
    """A folder with everything that can be wrong with a file, by what it is."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(cwd / "config"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cwd / "cache"))
    (cwd / "folder").mkdir()
    (cwd / "empty").write_bytes(b"")
    (cwd / "junk").write_bytes(bytes(range(256)) * 8)
    (cwd / FILES[4]).write_bytes(b"\xff\xfe\x00")
    (cwd / "file").write_text("here\n")
    return cwd


def arguments_of(command):
    return [p for p in command.params if p.param_type_name == "argument"]


def bounds_of(parameter):
    """(least, most) that an option takes; None where it has no bound."""
    return getattr(parameter.type, "min", None), getattr(parameter.type, "max", None)


def words_for(command, value):
    """Every argument that a command needs, with one value for all."""
    return [value for p in arguments_of(command) if p.required]


def wrong_calls():
    """(command's words, arguments, what is wrong) of all that can be made."""
    for name, command in sorted(EVERY.items()):
        needed = words_for(command, "missing")
        yield name, [*needed, "--no-such-option"], "option"
        yield name, [*needed, *["more"] * 9, "--no-such-option=3"], "option"
        if needed:
            yield name, needed[:-1], "argument"
        if not any(p.nargs == -1 for p in arguments_of(command)):
            yield name, [*needed, *["more"] * 9], "argument"
        for option, parameter in options_of(command).items():
            if option in ("--help", "--version"):
                continue
            kind = parameter.type.name.removesuffix(" range")
            if parameter.is_flag:
                yield name, [*needed, f"{option}=perhaps"], "flag"
                continue
            yield name, [*needed, option], "value"
            if kind in ("int", "float"):
                yield name, [*needed, option, "many"], "number"
                yield name, [*needed, option, "1_0x"], "number"
                least, most = bounds_of(parameter)
                if least is not None:
                    yield name, [*needed, option, str(least - 1)], "too small"
                if most is not None:
                    yield name, [*needed, option, str(2 * most + 1)], "too large"
                if kind == "int":
                    yield name, [*needed, option, "1.5"], "number"
                    yield name, [*needed, option, "nan"], "number"
            if option == "--set":
                yield name, [*needed, option, "no_such_key=1"], "set"
                yield name, [*needed, option, "="], "set"
            if option == "--json":
                yield name, [*needed, option, "file/below/x.json"], "place"
                yield name, [*needed, option, "folder"], "place"
                yield name, [*needed, option, "x" * 300], "place"
        if needed and name not in MAKES and name != "sniff":  # which looks at any file
            for file in FILES:
                yield name, words_for(command, file), f"file {file}"
    for name, after in HEARS.items():
        for source in SOURCES:
            yield name, [source, *after], "source"
    for source in SOURCES[1:]:
        yield "run", ["--source", source], "source"
        yield "emulate", ["native", "--source", source], "source"
    for codec in ("", "nope", "can-dbc?x", "\U0001f9e4"):
        yield "emulate", [codec], "codec"
        yield "hil", ["--codec", codec or "x"], "codec"
    for model in FILES:
        yield "run", ["--source", "synthetic:3x2?seconds=0.1", "--model", model], "model"
        yield "hil", ["--model", model], "model"


CALLS = list(wrong_calls())


@pytest.mark.parametrize("name", sorted(EVERY))
def test_a_wrong_call_is_one_line_and_leaves_nothing(call, place, name):
    before = sorted(path.name for path in place.iterdir())
    for words, arguments, what in CALLS:
        if words != name:
            continue
        code, out, err = call(*words.split(), *arguments)
        told = f"{words} {arguments}: {what}: {code}: {err}"
        assert code == CODES.get(name, 2), told
        assert err.startswith("tactile-rt: "), told
        assert err.count("\n") == 1, told
        assert not out, told
    after = {path.name for path in place.iterdir()} - {"cache", "config"}
    assert sorted(after) == before


def test_every_seed_and_number_of_threads_has_bounds():
    # A number that no generator takes is told by whoever is given it, each in words of its own.
    checked = {"train", "sweep"}  # where a recipe may hold it, too
    without = {
        f"{name} {option}"
        for name, command in EVERY.items()
        for option, parameter in options_of(command).items()
        if option in ("--seed", "--threads") and name not in checked
        and bounds_of(parameter)[1] is None
    }  # fmt: skip
    assert without == set()


def test_what_was_written_in_several_lines_is_told_in_one(refused, place):
    said = refused("model", "show", "no\nsuch\nmodel.onnx")
    assert "no such model.onnx" in said


@pytest.mark.parametrize("url", ["[x]", ".", "http://[::1", "a..b", "http://x:many"])
def test_what_is_no_address_of_a_daemon_is_one_line(refused, url):
    assert f"{url} is not like http://" in refused("top", url, "--once")


def test_a_place_that_takes_no_file_is_told_before_the_work(refused, place, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, how: False)
    said = refused("eval", "missing", "missing", "--json", "folder/figures.json")
    assert "folder may not be written into" in said
