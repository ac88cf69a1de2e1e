"""Faults of a daemon's world, each by real means: how one is caused, what must be told of it, and
how it ends."""

import os
import resource
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from bench.daemon.disturbed import DisturbedDaemon
from bench.daemon.overload import slow_down
from bench.daemon.process import free_port
from tests.helpers.hostile_models import GREEDY, no_number, write_burdened

STUCK_AT_S = 0.3
LEARNT_S, UNLIKE_S = 45.0, 2.4  # a stream's noise is known; 263 samples of ``finger``
DISK_MB, SPARE_MB = 96, 24  # of the recordings' file system; that must be free
STEP_S = 3600.0
STOPPED_S, STARVED_S = 3.0, 10.0
SLOW_MS = 300.0  # of a step that may take 45
FLOOD = 200
CONFIGURATION = f"""version = 1
[[source]]
name = "whiskers"
url = "{{whiskers}}"
stuck_at_s = {STUCK_AT_S}
[[source]]
name = "finger"
url = "{{finger}}"
[[model]]
source = "whiskers"
file = "wide.onnx"
[[model]]
source = "finger"
[[publisher]]
kind = "jsonl"
options = {{{{ state_s = 0.05 }}}}
[[publisher]]
kind = "zmq"
options = {{{{ bind = "tcp://127.0.0.1:{{zmq}}", state_s = 0.25 }}}}
[recorder]
folder = "disk/recordings"
min_free_mb = {SPARE_MB}
rotate_s = 5
[page]
port = {{page}}
[metrics]
port = {{metrics}}
[log]
format = "json"
"""

Named = tuple[str, str]  # part, what


class FaultScene(DisturbedDaemon):
    """The daemon, with its recordings on a small disk of their own.

    Attributes:
        disk: The folder of that disk.
        began: The time just before the daemon was started, CLOCK_MONOTONIC, s.
    """

    def __init__(self) -> None:
        super().__init__(configuration=CONFIGURATION, prepare=self._mount)
        self._mounted: Path | None = None

    def _mount(self, model: Path) -> None:
        self.began = time.monotonic()
        self.disk = model.parent / "disk"
        self.disk.mkdir()
        if may_mount():
            image = model.parent / "image"
            with image.open("wb") as file:
                file.truncate(DISK_MB * 1_000_000)
            _do("mkfs.ext4", "-q", "-m", "0", image)
            _do("mount", "-o", "loop", image, self.disk)
            self._stack.callback(_do, "umount", "-l", self.disk)
        self.good_model = model.read_bytes()

    def configure(
        self, further: str = "", change: Callable[[str], str] = lambda text: text
    ) -> None:
        """Let the daemon read another configuration; returns when it has, or has refused it."""
        since = self.mark()
        self.daemon.path.write_text(change(self.configuration) + further)
        self.daemon.reload()
        end = time.monotonic() + 20.0
        while not (self.told(since, "daemon", "reloaded") or self.told(since, "daemon", "refused")):
            if time.monotonic() > end:
                raise TimeoutError("the daemon has not reloaded")
            time.sleep(0.005)

    def put_model(self, data: bytes) -> None:
        """Another file takes the place of the model of ``whiskers``, and the daemon is told."""
        new = self.model.with_suffix(".new")
        new.write_bytes(data)
        new.replace(self.model)
        self.configure()

    def tidy(self) -> None:
        """Make room: recordings that are closed are deleted."""
        files = sorted((self.disk / "recordings").glob("*.mcap"), key=lambda f: f.stat().st_mtime)
        for file in files[:-4]:
            file.unlink(missing_ok=True)


def may_mount() -> bool:
    """Whether a file system can be mounted here, and processes be kept short."""
    tools = ("mount", "mkfs.ext4", "chattr", "fsfreeze", "mkswap", "swapon", "swapoff")
    return os.geteuid() == 0 and all(map(shutil.which, tools))


def _do(*command: object) -> None:
    subprocess.run([str(word) for word in command], check=True)


@dataclass(frozen=True)
class FaultKind:
    """A fault, and what must be told of it.

    Attributes:
        cause: A context manager that causes the fault where it is entered and ends it where it is
            left. It yields the time of the effect, CLOCK_MONOTONIC in s.
        named: What must be told: part and what is missing; nothing: it is no fault.
        also: What may be told besides, as it is true as well.
        lasts: Whether the fault lasts until it is ended; else it is over in a moment.
        root: Whether only the superuser can cause it.
        blind: Whether nobody answers while it lasts.
    """

    cause: "Callable[[FaultScene], Iterator[float]]"
    named: tuple[Named, ...] = ()
    also: tuple[Named, ...] = ()
    lasts: bool = True
    root: bool = False
    blind: bool = False


def _mood(array: str, mood: str, effect_s: float = 0.0) -> Callable[[FaultScene], Iterator[float]]:
    def cause(scene: FaultScene) -> Iterator[float]:
        scene.arrays[array].ask(f"mood {mood}")
        yield time.monotonic() + effect_s
        scene.arrays[array].ask("mood well")

    return cause


def _stuck_by_its_noise(scene: FaultScene) -> Iterator[float]:
    """Nobody describes the noise of the shipped model's sensor: the stream has to show it."""
    time.sleep(max(0.0, LEARNT_S - (time.monotonic() - scene.began)))
    yield from _mood("finger", "stuck", UNLIKE_S + 0.064)(scene)


def _unplugged(array: str) -> Callable[[FaultScene], Iterator[float]]:
    def cause(scene: FaultScene) -> Iterator[float]:
        scene.arrays[array].ask("unplug")
        yield time.monotonic()
        scene.arrays[array].ask("replug")

    return cause


def _exchanged(array: str) -> Callable[[FaultScene], Iterator[float]]:
    def cause(scene: FaultScene) -> Iterator[float]:
        line = scene.arrays[array]
        for word in ("unplug", "number B", "replug"):
            line.ask(word)
        yield time.monotonic() + 0.5  # until it has described itself
        for word in ("unplug", "number A", "replug"):
            line.ask(word)

    return cause


def _folder_deleted(scene: FaultScene) -> Iterator[float]:
    shutil.rmtree(scene.disk / "recordings")
    yield time.monotonic()


def _recordings_emptied(scene: FaultScene) -> Iterator[float]:
    """As a log rotator that copies a file and then cuts it short does with the newest ones."""
    files = (scene.disk / "recordings").glob("*.mcap")
    for file in sorted(files, key=lambda f: f.stat().st_mtime)[-2:]:
        os.truncate(file, 0)
    yield time.monotonic()


def _folder_is_a_file(scene: FaultScene) -> Iterator[float]:
    folder, aside = scene.disk / "recordings", scene.disk / "aside"
    folder.rename(aside)
    folder.write_text("")
    yield time.monotonic()
    folder.unlink()
    aside.rename(folder)


def _filled(scene: FaultScene, left_mb: float) -> Iterator[float]:
    filler = scene.disk / "filler"
    free = shutil.disk_usage(scene.disk).free
    with filler.open("wb", buffering=0) as file, suppress(OSError):
        os.posix_fallocate(file.fileno(), 0, max(1, free - round(1e6 * max(1.0, left_mb))))
        while not left_mb:
            file.write(bytes(1 << 16))  # until there is no room
    yield time.monotonic()
    filler.unlink()


def _little_room(scene: FaultScene) -> Iterator[float]:
    yield from _filled(scene, SPARE_MB / 2)


def _no_room(scene: FaultScene) -> Iterator[float]:
    scene.configure(change=lambda text: text.replace(f"= {SPARE_MB}", "= 0"))
    time.sleep(0.3)
    yield from _filled(scene, 0.0)
    scene.configure()


def _no_growth(scene: FaultScene) -> Iterator[float]:
    """No file of the process may be longer than what the recordings are already."""
    pid, most = scene.daemon.process.pid, resource.RLIM_INFINITY
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    yield time.monotonic()
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (most, before[1]))


def _disk_hangs(scene: FaultScene) -> Iterator[float]:
    _do("fsfreeze", "-f", scene.disk)
    yield time.monotonic()
    _do("fsfreeze", "-u", scene.disk)


def _disk_pulled_out(scene: FaultScene) -> Iterator[float]:
    """Its folder stays, and is the system's disk's."""
    _do("umount", "-l", scene.disk)
    yield time.monotonic()
    _do("mount", "-o", "loop", scene.disk.parent / "image", scene.disk)


def _folder_read_only(scene: FaultScene) -> Iterator[float]:
    """No file can be begun or taken away, and the one that was written is gone."""
    folder = scene.disk / "recordings"
    for file in folder.glob("*.mcap"):
        file.unlink()
    _do("chattr", "+i", folder)
    yield time.monotonic()
    _do("chattr", "-i", folder)


def _reader_stalls(scene: FaultScene) -> Iterator[float]:
    scene.read_pipe(False)
    # what the pipe holds is written before anything waits
    yield time.monotonic() + 0.4
    scene.read_pipe(True)


def _flooded(port: str) -> Callable[[FaultScene], Iterator[float]]:
    def cause(scene: FaultScene) -> Iterator[float]:
        with ExitStack() as stack:
            for _ in range(FLOOD):
                line = stack.enter_context(socket.socket())
                line.setblocking(False)
                line.connect_ex(("127.0.0.1", scene.ports[port]))
            yield time.monotonic()

    return cause


def _peer_that_never_reads(scene: FaultScene) -> Iterator[float]:
    import zmq

    context = zmq.Context()
    with context.socket(zmq.SUB) as peer:
        peer.setsockopt(zmq.RCVHWM, 1)
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.SUBSCRIBE, b"")
        peer.connect(f"tcp://127.0.0.1:{scene.ports['zmq']}")
        yield time.monotonic()
    context.destroy(0)


def _clock_set(scene: FaultScene) -> Iterator[float]:
    scene.clock.off_ns = 0 if scene.clock.off_ns else round(STEP_S * 1e9)
    yield time.monotonic()


def _stopped(scene: FaultScene) -> Iterator[float]:
    scene.daemon.process.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED_S)
    scene.daemon.process.send_signal(signal.SIGCONT)
    yield time.monotonic()


@contextmanager
def _kept_short(scene: FaultScene, what: str, old: str, new: str) -> Iterator[Callable[[str], int]]:
    """A control group of the daemon's process, version 1 or 2; what sets its limit."""
    root = Path("/sys/fs/cgroup")
    unified = (root / "cgroup.controllers").exists()
    group = (root if unified else root / what) / f"tactile-faults-{os.getpid()}"
    group.mkdir(exist_ok=True)
    pid, limit = str(scene.daemon.process.pid), group / (new if unified else old)
    (group / "cgroup.procs").write_text(pid)
    try:
        yield limit.write_text
    finally:
        (group.parent / "cgroup.procs").write_text(pid)
        group.rmdir()


def _starved(scene: FaultScene) -> Iterator[float]:
    """A hundredth of a processor for all of its threads."""
    unified = Path("/sys/fs/cgroup/cgroup.controllers").exists()
    with _kept_short(scene, "cpu", "cpu.cfs_quota_us", "cpu.max") as limit:
        limit("1000 100000" if unified else "1000")
        time.sleep(STARVED_S)
        limit("max" if unified else "-1")
        yield time.monotonic()


def _swapped_out(scene: FaultScene) -> Iterator[float]:
    """Half of its memory, again and again."""
    swap = scene.folder / "swap"
    if not swap.exists():
        swap.touch(0o600)
        with swap.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, 1 << 29)
        _do("mkswap", "-q", swap)
    unified = Path("/sys/fs/cgroup/cgroup.controllers").exists()
    status = Path(f"/proc/{scene.daemon.process.pid}/status").read_text()
    resident = 1024 * int(status.partition("VmRSS:")[2].split()[0])
    _do("swapon", swap)
    try:
        with _kept_short(scene, "memory", "memory.limit_in_bytes", "memory.high") as limit:
            limit(str(resident // 2))
            yield time.monotonic()
            limit("max" if unified else "-1")
    finally:
        _do("swapoff", swap)


def _reloaded(further: str) -> Callable[[FaultScene], Iterator[float]]:
    """A part that cannot work is configured, and taken out again."""

    def cause(scene: FaultScene) -> Iterator[float]:
        scene.configure(further.replace("FOLDER", str(scene.folder)))
        yield time.monotonic()
        scene.configure()

    return cause


def _no_threads(scene: FaultScene) -> Iterator[float]:
    with _kept_short(scene, "pids", "pids.max", "pids.max") as limit:
        limit("1")
        scene.daemon.reload()
        yield time.monotonic()
        limit("max")
    scene.configure()


def _port_taken(scene: FaultScene) -> Iterator[float]:
    port = free_port()
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", port))
        holder.listen()
        options = f'options = {{ bind = "tcp://127.0.0.1:{port}" }}\n'
        scene.configure(f'[[publisher]]\nkind = "zmq"\nname = "second"\n{options}')
        yield time.monotonic()
    # now it is free, and the next try takes it


def _garbage_configuration(scene: FaultScene) -> Iterator[float]:
    scene.configure('[[publisher]]\nkind = "smoke"\n')
    yield time.monotonic()
    scene.configure()


def _pipe_configuration(scene: FaultScene) -> Iterator[float]:
    since = scene.mark()
    scene.daemon.path.unlink()
    os.mkfifo(scene.daemon.path)
    scene.daemon.reload()
    yield scene.await_told(since, "daemon", "refused").t_ns / 1e9
    scene.daemon.path.unlink()
    scene.configure()


def _garbage_model(scene: FaultScene) -> Iterator[float]:
    scene.put_model(b"no model\n" * 1000)
    yield time.monotonic()
    since = scene.mark()
    scene.put_model(scene.good_model)
    scene.await_told(since, "model.whiskers", "admitted")  # its trial reads the file, too


def _greedy_model(scene: FaultScene) -> Iterator[float]:
    since = scene.mark()
    file = scene.folder / "greedy.onnx"
    good = scene.folder / "good.onnx"
    good.write_bytes(scene.good_model)
    scene.put_model(write_burdened(file, GREEDY["outer_product_1.3_GB"], good).read_bytes())
    yield scene.await_told(since, "model.whiskers", "refused").t_ns / 1e9
    since = scene.mark()
    scene.put_model(scene.good_model)
    scene.await_told(since, "model.whiskers", "admitted")


def _model_without_numbers(scene: FaultScene) -> Iterator[float]:
    since, file, good = scene.mark(), scene.folder / "numberless.onnx", scene.folder / "good.onnx"
    good.write_bytes(scene.good_model)
    scene.put_model(write_burdened(file, no_number, good).read_bytes())
    # what it answers is seen when something is touched
    yield scene.await_told(since, "model.whiskers", "admitted").t_ns / 1e9 + 2.0
    since = scene.mark()
    scene.put_model(scene.good_model)
    scene.await_told(since, "model.whiskers", "admitted")


def _slow_model(scene: FaultScene) -> Iterator[float]:
    slow = scene.folder / "slow.onnx"
    if not slow.exists():
        slow.write_bytes(scene.good_model)
        slow_down(slow, SLOW_MS)
    since = scene.mark()
    scene.put_model(slow.read_bytes())
    # what it does not decide is seen when something is touched
    yield scene.await_told(since, "model.whiskers", "admitted").t_ns / 1e9 + 2.0
    since = scene.mark()
    scene.put_model(scene.good_model)
    scene.await_told(since, "model.whiskers", "admitted")


def _log_full(scene: FaultScene) -> Iterator[float]:
    scene.configure(change=lambda text: text.replace("[log]\n", '[log]\nfile = "/dev/full"\n'))
    yield time.monotonic()
    scene.configure()


def _two_at_once(scene: FaultScene) -> Iterator[float]:
    room, plug = contextmanager(_little_room), contextmanager(_unplugged("finger"))
    with room(scene), plug(scene) as began:
        yield began


def _nothing(scene: FaultScene) -> Iterator[float]:
    yield time.monotonic()


LATE_TOO = (
    ("source.whiskers", "lost samples"), ("source.finger", "lost samples"),
    ("source.whiskers", "late samples"), ("source.finger", "late samples"),
    ("model.whiskers", "missing decisions"), ("model.finger", "missing decisions"),
)  # fmt: skip
RECORDER = ("recorder", "no recording")
GHOST = '[[source]]\nname = "ghost"\nurl = "serial:///dev/not_there?codec=native"\n'
FULL = '[[publisher]]\nkind = "jsonl"\nname = "full"\noptions = { file = "/dev/full" }\n'
KINDS: dict[str, FaultKind] = {
    "nothing_at_all": FaultKind(_nothing),
    "serial_cable_pulled": FaultKind(
        _unplugged("whiskers"), (("source.whiskers", "no samples"),),
        (("source.whiskers", "lost samples"),),
    ),
    "can_cable_pulled": FaultKind(
        _unplugged("finger"), (("source.finger", "no samples"),),
        (("source.finger", "lost samples"),),
    ),
    "serial_device_silent": FaultKind(
        _mood("whiskers", "silent"), (("source.whiskers", "no samples"),),
        (("source.whiskers", "lost samples"),),
    ),
    "can_device_silent": FaultKind(
        _mood("finger", "silent"), (("source.finger", "no samples"),),
        (("source.finger", "lost samples"),),
    ),
    "device_stuck": FaultKind(
        _mood("whiskers", "stuck", STUCK_AT_S + 0.064), (("source.whiskers", "stuck-at fault"),)
    ),
    "undescribed_device_stuck": FaultKind(
        _stuck_by_its_noise, (("source.finger", "stuck-at fault"),)
    ),
    "device_slow": FaultKind(  # two seconds are given to see it
        _mood("whiskers", "slow", 1.0 + 0.064), (("source.whiskers", "slow"),)
    ),
    "can_device_slow": FaultKind(_mood("finger", "slow", 1.0 + 0.5), (("source.finger", "slow"),)),
    "counter_stuck": FaultKind(
        _mood("whiskers", "uncounted", 0.064), (("source.whiskers", "no counter"),)
    ),
    "device_fast": FaultKind(_mood("whiskers", "fast", 1.5), (("source.whiskers", "fast"),)),
    "array_exchanged": FaultKind(
        _exchanged("whiskers"), (("source.whiskers", "another array"),),
        (("source.whiskers", "lost samples"), ("source.whiskers", "no samples")),
    ),
    "device_fails": FaultKind(
        _mood("whiskers", "fails", 0.064), (("source.whiskers", "device fault"),)
    ),
    "can_device_fails": FaultKind(
        _mood("finger", "fails", 0.2), (("source.finger", "device fault"),)
    ),
    "no_numbers": FaultKind(
        _mood("whiskers", "no_number", 0.064), (("source.whiskers", "bad samples"),)
    ),
    "frames_damaged": FaultKind(
        _mood("whiskers", "corrupt", 0.064), (("source.whiskers", "lost samples"),)
    ),
    "samples_missing": FaultKind(
        _mood("whiskers", "gaps", 0.064), (("source.whiskers", "lost samples"),)
    ),
    "can_samples_missing": FaultKind(
        _mood("finger", "gaps", 0.2), (("source.finger", "lost samples"),)
    ),
    "recordings_deleted": FaultKind(_folder_deleted, (RECORDER,), lasts=False),
    "recordings_emptied": FaultKind(_recordings_emptied, (RECORDER,), lasts=False),
    "folder_is_a_file": FaultKind(_folder_is_a_file, (RECORDER,)),
    "folder_read_only": FaultKind(_folder_read_only, (RECORDER,), root=True),
    "disk_pulled_out": FaultKind(_disk_pulled_out, (RECORDER,), root=True),
    "disk_hangs": FaultKind(_disk_hangs, (RECORDER,), root=True),
    "little_room": FaultKind(_little_room, (RECORDER,), root=True),
    "no_room": FaultKind(_no_room, (RECORDER,), root=True),
    "files_may_not_grow": FaultKind(_no_growth, (RECORDER,), (("log", "no log"),)),
    "reader_of_a_pipe_stalls": FaultKind(
        _reader_stalls, (("publisher.jsonl", "not published"),)
    ),
    "page_flooded": FaultKind(_flooded("page"), (("page", "no page"),)),
    "publisher_flooded": FaultKind(
        _flooded("zmq"), (("publisher.zmq", "not published"),)
    ),
    "peer_never_reads": FaultKind(_peer_that_never_reads),
    "wall_clock_set": FaultKind(_clock_set, (("daemon", "UTC has jumped"),), lasts=False),
    "process_stopped": FaultKind(
        _stopped, (("daemon", "late"),), LATE_TOO, lasts=False, blind=True
    ),
    "processor_starved": FaultKind(
        _starved, (("daemon", "late"),), LATE_TOO, lasts=False, root=True, blind=True
    ),
    "memory_swapped_out": FaultKind(_swapped_out, (), (("daemon", "late"), *LATE_TOO), root=True),
    "no_threads": FaultKind(_no_threads, (("daemon", "old configuration"),), root=True),
    "port_taken": FaultKind(_port_taken, (("publisher.second", "not published"),)),
    "device_not_there": FaultKind(_reloaded(GHOST), (("source.ghost", "no samples"),)),
    "file_cannot_be_written": FaultKind(
        _reloaded(FULL), (("publisher.full", "not published"),)
    ),
    "log_cannot_be_written": FaultKind(_log_full, (("log", "no log"),)),
    "configuration_is_garbage": FaultKind(
        _garbage_configuration, (("daemon", "old configuration"),)
    ),
    "configuration_is_a_pipe": FaultKind(
        _pipe_configuration, (("daemon", "old configuration"),)
    ),
    "model_is_garbage": FaultKind(_garbage_model, (("daemon", "old configuration"),)),
    "model_is_greedy": FaultKind(_greedy_model, (("model.whiskers", "old model"),)),
    "model_without_numbers": FaultKind(
        _model_without_numbers, (("model.whiskers", "no decisions"),)
    ),
    "model_is_slow": FaultKind(
        _slow_model, (("model.whiskers", "missing decisions"),),
        (("model.whiskers", "late decisions"),),
    ),
    "two_at_once": FaultKind(
        _two_at_once, (RECORDER, ("source.finger", "no samples")),
        (("source.finger", "lost samples"),), root=True,
    ),
}  # fmt: skip
