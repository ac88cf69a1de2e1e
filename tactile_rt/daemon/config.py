"""The daemon's configuration: the keys of one TOML file, with units and ranges.

Version 1 of the keys is stable: a valid file stays valid in later releases, or is refused for its
``version``, but never misread. Relative paths start at the file's folder. `loading` reads such a
file, `checks` tests whether it can work; `EXAMPLE` explains its keys, and the docstrings those that
it leaves out.
"""

import ipaddress
import json
from typing import Annotated, Any, Literal

import msgspec

ADMISSION = "tactile-rt admission"  # the thread that loads a model; must not be ended meanwhile
CONFIG_VERSION = 1

NAME = "name: letters, digits, - and _, 64 at most"
Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,64}\Z", description=NAME)]
OptionalName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{0,64}\Z", description=NAME)]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=4096)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
Megabytes = Annotated[float, msgspec.Meta(ge=0, le=1e7)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class SourceConfig(_Table, frozen=True, kw_only=True):
    """Table ``[[source]]``: a source of one array's samples.

    Attributes:
        array: A file that describes the source's array, as `tactile-rt describe` writes it, or an
            ``.onnx`` model made for that array; empty if the URL determines the array.
        stuck_at_s: Time without a change of any value that counts as a stuck-at fault, s. With 0 it
            is derived from the noise, if the model, the tare or the stream determines the noise; if
            not, there is no limit, as a coarse sensor at rest does not change either.
    """

    name: Name
    url: str
    calibration: str = ""
    array: str = ""
    stuck_at_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.0


class ModelConfig(_Table, frozen=True, kw_only=True):
    """Table ``[[model]]``: a classifier of one source's samples.

    Attributes:
        mode: ``episode`` decides from the onset on, better with every step; ``sliding`` decides
            every `every` steps while contact lasts, from a window of the newest steps as long as
            an episode.
        every: Number of steps from one sliding decision to the next, at most those of an episode;
            0 means 4, or all steps of a shorter episode.
        sure: Probability that ends an episode early when one class reaches it in `in_a_row`
            consecutive steps; 0 means never.
        in_a_row: Number of consecutive steps for `sure`, at most those of an episode.
        fuse_s: Time within which successive touches count as touches of one object, which is
            identified from all of them, s; 0 identifies each touch alone.
        providers: Execution providers of onnxruntime, best first: ``cpu``, ``cuda``, ``tensorrt``.
    """

    file: str = ""
    source: str = ""
    name: OptionalName = ""
    decisions: Literal["every_step", "final"] = "every_step"
    mode: Literal["episode", "sliding"] = "episode"
    every: Annotated[int, msgspec.Meta(ge=0)] = 0
    sure: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    in_a_row: Annotated[int, msgspec.Meta(ge=1)] = 2
    deadline_ms: Annotated[float, msgspec.Meta(ge=0, le=10_000)] = 0.0
    late: Literal["count", "report", "skip"] = "count"
    catch_up: Literal["newest", "all"] = "newest"
    behind_ms: Annotated[float, msgspec.Meta(ge=0, le=60_000)] = 0.0
    fuse_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.0
    providers: Annotated[tuple[Text, ...], msgspec.Meta(min_length=1)] = ("cpu",)


class PublisherConfig(_Table, frozen=True, kw_only=True):
    """Table ``[[publisher]]``: a destination of messages.

    Attributes:
        kind: One of `publishers.PUBLISHERS`, or one that another package adds.
        name: The name of the publisher in the log and on the page; by default its kind.
        options: The table of options that this kind of publisher takes.
    """

    kind: Text
    name: OptionalName = ""
    options: dict[str, Any] = {}


class RecorderConfig(_Table, frozen=True, kw_only=True):
    """Table ``[recorder]``: recording into MCAP files."""

    folder: Text
    rotate_mb: Megabytes = 512.0
    rotate_s: Seconds = 3600.0
    min_free_mb: Megabytes = 1024.0
    sync_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    mode: Literal["always", "trigger"] = "always"
    before_s: Annotated[float, msgspec.Meta(ge=0, le=600)] = 10.0
    after_s: Annotated[float, msgspec.Meta(ge=0, le=600)] = 5.0


class PageConfig(_Table, frozen=True, kw_only=True):
    """Table ``[page]``: the web page."""

    host: Text = "127.0.0.1"
    port: Port = 8765
    token: str = ""
    control: bool = False


class MetricsConfig(_Table, frozen=True, kw_only=True):
    """Table ``[metrics]``: Prometheus metrics and health over HTTP, loopback only by default."""

    host: Text = "127.0.0.1"
    port: Port = 9464


class LogConfig(_Table, frozen=True, kw_only=True):
    """Table ``[log]``: the log, with one line per event."""

    level: Literal["info", "warning", "error"] = "info"
    format: Literal["text", "json"] = "text"
    file: str = ""
    repeat_s: Annotated[float, msgspec.Meta(ge=1, le=86400)] = 60.0


class LimitsConfig(_Table, frozen=True, kw_only=True):
    """Table ``[limits]``: sizes of queues and limits of time, explained in `EXAMPLE`."""

    queue_items: Annotated[int, msgspec.Meta(ge=16, le=1_000_000)] = 4096
    queue_mb: Annotated[float, msgspec.Meta(ge=1, le=4096)] = 32.0
    model_queue_items: Annotated[int, msgspec.Meta(ge=2, le=100_000)] = 1024
    gather_ms: Annotated[float, msgspec.Meta(ge=0, le=100)] = 2.0
    model_mb: Annotated[float, msgspec.Meta(ge=16, le=1_000_000)] = 256.0
    model_s: Annotated[float, msgspec.Meta(ge=1, le=3600)] = 60.0
    stop_s: Annotated[float, msgspec.Meta(ge=0.2, le=60)] = 2.0
    stall_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600)] = 5.0
    sample_age_s: Annotated[float, msgspec.Meta(ge=0.05, le=3600)] = 0.5
    behind_s: Annotated[float, msgspec.Meta(ge=0.05, le=3600)] = 0.75
    record_age_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600)] = 1.0
    retry_first_s: Annotated[float, msgspec.Meta(ge=0.01, le=60)] = 0.1
    retry_last_s: Annotated[float, msgspec.Meta(ge=0.01, le=3600)] = 2.0


class Config(_Table, frozen=True, kw_only=True):
    """The whole configuration file: a table or list of tables per kind of part."""

    version: Literal[1]
    source: tuple[SourceConfig, ...] = ()
    model: tuple[ModelConfig, ...] = ()
    publisher: tuple[PublisherConfig, ...] = ()
    recorder: RecorderConfig | None = None
    page: PageConfig | None = None
    metrics: MetricsConfig | None = None
    log: LogConfig = LogConfig()
    limits: LimitsConfig = LimitsConfig()


def is_loopback(host: str) -> bool:
    """Return whether a host is localhost or a loopback address, unreachable for other computers."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


EXAMPLE = """\
# To use what is commented out, remove the first # of the line.
# Run it: tactile-rt run robot.toml     Paths are meant from this file's folder.
version = 1

[[source]]
name = "whiskers"
url = "replay:demo?loop=true"  # six recorded objects; a device: serial:///dev/ttyACM0?codec=native
                               # "synthetic:mouse" is made up: decisions on it mean nothing
# calibration = "cell-3"       # file, or id of a device: tactile-rt calibrate
# stuck_at_s = 0                 # no change for so long: stuck-at fault; 0: if its noise is known
# array = "array.json"         # what the device is, if its codec cannot know; or a model's .onnx

[[model]]                      # none: nothing is classified
source = "whiskers"            # needed if there are several
# file = "model.onnx"          # default: the one that comes with the package
# decisions = "every_step"     # or "final": one per contact
# deadline_ms = 0              # older, or longer to make, is late; 0: one step
# late = "count"               # or "report" in the log, "skip": late decisions are not published
# catch_up = "newest"          # what is behind skips to the newest sample; "all": takes every step
# behind_ms = 0                # how far it may be behind; 0: three steps, at least 150 ms
# fuse_s = 0                   # touches within so long are of one object, of those enrolled

[[publisher]]
kind = "jsonl"                 # also zmq, zenoh, foxglove, ros2
options = { samples = false }  # file: default standard output; state_s: how often

# [recorder]
# folder = "recordings"
# rotate_mb = 512              # a new file after so much; 0: never
# rotate_s = 3600
# min_free_mb = 1024           # with less free space nothing is recorded
# sync_s = 1                   # what a power cut may take; 0: all that the system has not written
# mode = "always"              # or "trigger": around contacts and faults
# before_s = 10
# after_s = 5

[page]
host = "127.0.0.1"             # beyond loopback a token is needed
port = 8765                    # http://127.0.0.1:8765
# token = ""
# control = false              # true: the page may start and stop the recorder

# [metrics]
# host = "127.0.0.1"
# port = 9464

[log]
level = "info"                 # warning, error
format = "text"                # json
# file = "daemon.log"          # default: stderr, which systemd keeps
repeat_s = 60                  # what comes again within so long is counted, not written

[limits]
queue_items = 4096             # what may wait for one consumer before the oldest goes
queue_mb = 32
model_queue_items = 1024       # chunks that may wait for one model
gather_ms = 2                  # more takes less of the processor, and adds to the latency
model_mb = 256                 # memory that a model may need, beside four times its file
model_s = 60                   # time that it may need to load and warm up
stop_s = 2                     # how long closing may take
stall_s = 5                    # a call that takes longer is reported as stalled
sample_age_s = 0.5             # what is older than these makes the daemon degraded: a sample,
behind_s = 0.75                # what waits for a model or a publisher,
record_age_s = 1               # a sample that is not on the disk
retry_first_s = 0.1            # pause before a part that broke is tried again, doubling
retry_last_s = 2
"""


# as TOML again

SECRETS = ("token", "password", "secret", "key")
HIDDEN = "***"


def config_text(config: Config) -> str:
    """Return a configuration as TOML with all defaults, and with secrets hidden."""
    lines = [f"version = {config.version}"]
    for table, several in (
        ("source", True), ("model", True), ("publisher", True), ("recorder", False),
        ("page", False), ("metrics", False), ("log", False), ("limits", False),
    ):  # fmt: skip
        found = getattr(config, table)
        for one in found if several else [found] if found is not None else []:
            lines += ["", f"[[{table}]]" if several else f"[{table}]"]
            for key, value in msgspec.structs.asdict(one).items():
                lines.append(f"{key} = {_format_toml(_hide_secrets(key, value))}")
    return "\n".join(lines) + "\n"


def _hide_secrets(key: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _hide_secrets(k, v) for k, v in value.items()}
    secret = any(key.lower() == s or key.lower().endswith(f"_{s}") for s in SECRETS)
    return HIDDEN if secret and isinstance(value, str) and value else value


def _format_toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's basic strings are JSON's, except for a control character that JSON does not escape.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, float):
        text = repr(value)
        return text if any(c in text for c in ".en") else f"{text}.0"
    if isinstance(value, dict):
        pairs = [f"{_format_toml(k)} = {_format_toml(v)}" for k, v in value.items()]
        inner = ", ".join(pairs)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_toml, value))}]"
    return str(value) if isinstance(value, int) else value.isoformat()
