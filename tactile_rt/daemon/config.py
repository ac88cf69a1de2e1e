"""The daemon's configuration: what one TOML file may say, with units and ranges.

Version 1 of the keys is promised: a file that is right for it stays right for later releases, or
is refused by its ``version``, never misread. Relative paths are meant from the file's folder.
"""

from typing import Annotated, Any, Literal

import msgspec

__all__ = [
    "CONFIG_VERSION",
    "EXAMPLE",
    "Config",
    "LimitsConfig",
    "LogConfig",
    "MetricsConfig",
    "ModelConfig",
    "PageConfig",
    "PublisherConfig",
    "RecorderConfig",
    "SourceConfig",
]

CONFIG_VERSION = 1

Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{1,64}\Z")]
OptionalName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9_-]{0,64}\Z")]
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=4096)]
Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
Megabytes = Annotated[float, msgspec.Meta(ge=0, le=1e7)]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    pass


class SourceConfig(_Table, frozen=True, kw_only=True):
    """``[[source]]``: an array.

    Attributes:
        name: what it is called everywhere.
        url: as for `tactile-rt run --source`.
        calibration: file, or id of a device calibrated before; empty: none.
    """

    name: Name
    url: Text
    calibration: str = ""


class ModelConfig(_Table, frozen=True, kw_only=True):
    """``[[model]]``: a classifier on a source.

    Attributes:
        file: ``.onnx``; empty: the model that comes with the package.
        source: name of its source; needed if there are several.
        name: what it is called; empty: as its source.
        decisions: what is published: ``every_step``, or ``final`` ones alone.
        mode: ``episode``: one decision from the onset on, better with every step; ``sliding``: as
            long as contact lasts, one about the newest 22 steps, `every` so many of them.
        every: steps from one to the next when sliding; 0: 4.
        sure: an episode ends early when a class is as probable as this `in_a_row` steps; 0: never.
        deadline_ms: how long a step may take, ms; 0: as long as the step itself.
        late: what becomes of a step that took longer: ``count``, ``report`` in the log, or
            ``skip``: its decision is not published.
        providers: of onnxruntime, best first: ``cpu``, ``cuda``, ``tensorrt`` ...
    """

    file: str = ""
    source: str = ""
    name: OptionalName = ""
    decisions: Literal["every_step", "final"] = "every_step"
    mode: Literal["episode", "sliding"] = "episode"
    every: Annotated[int, msgspec.Meta(ge=0, le=22)] = 0
    sure: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    in_a_row: Annotated[int, msgspec.Meta(ge=1, le=22)] = 2
    deadline_ms: Annotated[float, msgspec.Meta(ge=0, le=10_000)] = 0.0
    late: Literal["count", "report", "skip"] = "count"
    providers: Annotated[tuple[Text, ...], msgspec.Meta(min_length=1)] = ("cpu",)


class PublisherConfig(_Table, frozen=True, kw_only=True):
    """``[[publisher]]``: where messages go.

    Attributes:
        kind: ``jsonl``, ``zmq``, ``zenoh``, ``foxglove``, or one that another package adds.
        name: what it is called; empty: as its kind.
        options: its own table.
    """

    kind: Text
    name: OptionalName = ""
    options: dict[str, Any] = {}


class RecorderConfig(_Table, frozen=True, kw_only=True):
    """``[recorder]``: MCAP files.

    Attributes:
        folder: where to; made if it is not there.
        rotate_mb, rotate_s: a new file begins after so much, or so long; 0: never.
        min_free_mb: below so much free space nothing is recorded.
        mode: ``always``, or ``trigger``: around contacts and faults.
        before_s, after_s: of a trigger, what is kept.
    """

    folder: Text
    rotate_mb: Megabytes = 512.0
    rotate_s: Seconds = 3600.0
    min_free_mb: Megabytes = 1024.0
    mode: Literal["always", "trigger"] = "always"
    before_s: Annotated[float, msgspec.Meta(ge=0, le=600)] = 10.0
    after_s: Annotated[float, msgspec.Meta(ge=0, le=600)] = 5.0


class PageConfig(_Table, frozen=True, kw_only=True):
    """``[page]``: the web page.

    Attributes:
        host: address to listen on; beyond loopback a token is needed.
        port: of it.
        token: what a browser must know, at least 16 characters; empty: nothing.
        control: whether the page may do more than look.
    """

    host: Text = "127.0.0.1"
    port: Port = 8765
    token: str = ""
    control: bool = False


class MetricsConfig(_Table, frozen=True, kw_only=True):
    """``[metrics]``: Prometheus metrics and the health endpoint, loopback only by default."""

    host: Text = "127.0.0.1"
    port: Port = 9464


class LogConfig(_Table, frozen=True, kw_only=True):
    """``[log]``: one line per event.

    Attributes:
        level: the least that is worth a line.
        format: ``text`` or ``json``.
        file: where to; empty: stderr, which systemd keeps.
        repeat_s: what comes again within so long is counted, and told once: "repeated n times".
    """

    level: Literal["info", "warning", "error"] = "info"
    format: Literal["text", "json"] = "text"
    file: str = ""
    repeat_s: Annotated[float, msgspec.Meta(ge=1, le=86400)] = 60.0


class LimitsConfig(_Table, frozen=True, kw_only=True):
    """``[limits]``.

    Attributes:
        queue_items, queue_mb: what may wait for one consumer, before the oldest goes.
        model_queue_items: chunks that may wait for one model.
        gather_ms: how long a model waits for more samples before it looks at those that came; less
            is sooner, more takes less of the processor.
        stop_s: how long closing may take.
        stall_s: a call that takes longer is told as stalled.
        retry_first_s, retry_last_s: pause before a part that broke is tried again; it doubles from
            the first to the last.
    """

    queue_items: Annotated[int, msgspec.Meta(ge=16, le=1_000_000)] = 4096
    queue_mb: Annotated[float, msgspec.Meta(ge=1, le=4096)] = 32.0
    model_queue_items: Annotated[int, msgspec.Meta(ge=2, le=100_000)] = 1024
    gather_ms: Annotated[float, msgspec.Meta(ge=0, le=100)] = 2.0
    stop_s: Annotated[float, msgspec.Meta(ge=0.2, le=60)] = 2.0
    stall_s: Annotated[float, msgspec.Meta(ge=0.5, le=3600)] = 5.0
    retry_first_s: Annotated[float, msgspec.Meta(ge=0.01, le=60)] = 0.1
    retry_last_s: Annotated[float, msgspec.Meta(ge=0.01, le=3600)] = 2.0


class Config(_Table, frozen=True, kw_only=True):
    """The file.

    Attributes:
        version: of these keys.
        extends: a file that this one adds to and overrides; gone once it is read.
    """

    version: Literal[1]
    extends: str = ""
    source: tuple[SourceConfig, ...] = ()
    model: tuple[ModelConfig, ...] = ()
    publisher: tuple[PublisherConfig, ...] = ()
    recorder: RecorderConfig | None = None
    page: PageConfig | None = None
    metrics: MetricsConfig | None = None
    log: LogConfig = LogConfig()
    limits: LimitsConfig = LimitsConfig()


EXAMPLE = """\
# To use what is commented out, remove the first # of the line.
# Run it: tactile-rt run robot.toml     Paths are meant from this file's folder.
version = 1
# extends = "base.toml"        # what is here adds to that file and overrides it

[[source]]
name = "whiskers"
url = "synthetic:35x6"         # a device: serial:///dev/ttyACM0?codec=native
# calibration = "cell-3"       # file, or id of a device: tactile-rt calibrate

# [[model]]                    # none: nothing is classified
# source = "whiskers"          # needed if there are several
# file = "model.onnx"          # default: the one that comes with the package
# decisions = "every_step"     # or "final": one per contact

[[publisher]]
kind = "jsonl"                 # also zmq, zenoh, foxglove
options = { samples = false }  # file: default standard output; state_s: how often

# [recorder]
# folder = "recordings"
# rotate_mb = 512              # a new file after so much; 0: never
# rotate_s = 3600
# min_free_mb = 1024           # with less free space nothing is recorded
# mode = "always"              # or "trigger": around contacts and faults
# before_s = 10
# after_s = 5

# [page]
# host = "127.0.0.1"           # beyond loopback a token is needed
# port = 8765
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
stop_s = 2                     # how long closing may take
stall_s = 5                    # a call that takes longer is told as stalled
retry_first_s = 0.1            # pause before a part that broke is tried again, doubling
retry_last_s = 2
"""
