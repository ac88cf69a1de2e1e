"""The page of sources, docs/reference/sources.md, names every scheme, and options that exist."""

import re
import shutil

import pytest

from tactile_rt.recording.replay import DEMO
from tactile_rt.sources.opening import SCHEMES, check_source
from tests.helpers.source_tree import ROOT

PAGE = (ROOT / "docs" / "reference" / "sources.md").read_text("utf-8")
URL = re.compile(rf"(?:^|[`'])((?:{'|'.join(SCHEMES)}):[^\s`']+)", re.M)
URLS = [url for url in dict.fromkeys(URL.findall(PAGE)) if not re.search("ARRAY|FILE|SET", url)]


def test_every_scheme_has_an_example() -> None:
    named = [*dict.fromkeys(url.partition(":")[0] for url in URLS)]
    assert re.findall(r"^\| `(\w+)` \|[^|]+\| `\1:", PAGE, re.M) == named
    assert set(named) == set(SCHEMES)


@pytest.mark.parametrize("url", URLS)
def test_the_examples_are_sources(url: str, cwd) -> None:
    if url.startswith(("sim:", "whisking:")):
        pytest.importorskip("mujoco")
        pytest.importorskip("trimesh")
    shutil.copy(DEMO, "touches.mcap")
    (cwd / "head.toml").write_text(
        'name = "head"\nrate_hz = 1000\n[[source]]\nname = "left"\nurl = "synthetic:"\n'
    )
    check_source(url)


@pytest.mark.parametrize(
    ("heading", "url"),
    [
        ("Devices", "serial:///dev/ttyUSB0?codec=bota"),
        ("Devices", "can:socketcan:can0?codec=xela"),
        ("Recordings", "replay:demo"),
        ("Simulated sweeps", "sim:mouse"),
        ("Simulated whisking", "whisking:mouse"),
    ],
)
def test_the_options_and_their_defaults_are_the_code_s(heading: str, url: str) -> None:
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`.+?) \| (.+?) \| (.+?) \|$", section, re.M)
    assert len(rows) >= 3
    scheme = url.partition(":")[0]
    for names, default, meaning in rows:
        if scheme in ("serial", "can") and meaning.startswith(("serial", "CAN")):
            if not meaning.lower().startswith(scheme):
                continue
        known = _options(scheme)
        values = default.split(", ") if heading != "Simulated whisking" else [default]
        for k, name in enumerate(re.findall(r"`(\w+)`", names)):
            if name == "from":
                continue  # of `prepare_replay` itself
            assert name in known, name
            value = values[min(k, len(values) - 1)].strip("`")
            if re.fullmatch(r"[\d.]+|false|realtime", value) and name != "size_mm":
                assert str(known[name]).lower().removesuffix(".0") == value, name


def _options(scheme: str) -> dict[str, object]:
    """The options of a scheme and their defaults."""
    if scheme in ("sim", "whisking"):
        pytest.importorskip("mujoco")
        pytest.importorskip("trimesh")
    from importlib import import_module

    from tactile_rt.drivers.opening import CanOptions, SerialOptions
    from tactile_rt.recording.replay import ReplayOptions

    kinds = {"serial": SerialOptions, "can": CanOptions, "replay": ReplayOptions}
    if scheme not in kinds:
        module, name, _ = SCHEMES[scheme]
        kinds[scheme] = getattr(import_module(module), name).Options
    return {name: one.default for name, one in kinds[scheme].__dataclass_fields__.items()}
