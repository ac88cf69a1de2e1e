"""Each extra alone in an environment, and the first command that its page has."""

import shutil
from collections.abc import Callable
from pathlib import Path

from bench.roads.walking import ROOT, Failed, Road

LARGEST_MB = 220.0  # of `onboard`
GYM = """\
import tactile_rt
import gymnasium
name = "tactile_rt.sim_backend.environments:tactile_rt/ActiveWhisking-v0"
env = gymnasium.make(name)
env.reset(seed=0)
print("reward", env.step(env.action_space.sample())[1])
"""
BAG = """\
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
store = get_typestore(Stores.ROS1_NOETIC)
Wrench, V = (store.types[f"geometry_msgs/msg/{n}"] for n in ("WrenchStamped", "Vector3"))
Header, Time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
Inner = store.types["geometry_msgs/msg/Wrench"]
with Writer("run.bag") as bag:
    line = bag.add_connection("/wrench", Wrench.__msgtype__, typestore=store)
    for k in range(100):
        said = Wrench(Header(k, Time(k // 100, k % 100 * 10_000_000), "tip"),
                      Inner(V(0.1 * k, 0.0, 1.0), V(0.0, 0.0, 0.0)))
        bag.write(line, k * 10_000_000, store.serialize_ros1(said, Wrench.__msgtype__))
"""
PUBLISHERS = 'version = 1\n[[source]]\nname = "a"\nurl = "replay:demo?loop=true"\n[[model]]\n'


def _sim(road: Road) -> None:
    source = "sim:mouse?objects=mug-50&sweeps=1&pace=fast"
    road.step("decide", "tactile-rt", "run", "--source", source, "--final-only", says=['"label"'])


def _gym(road: Road) -> None:
    road.step("act", "python", "-c", GYM, says=["reward"])


def _view(road: Road) -> None:
    road.step("draw", "tactile-rt", "view", "mug-50", "--out", "mug.png")
    road.step("film", "tactile-rt", "view", "mug-50", "--out", "mug.mp4")


def _train(road: Road) -> None:
    names = [f"{kind}-{k}.mcap" for kind in ("one", "other") for k in range(3)]
    for name in names:
        road.step("record", "tactile-rt", "record", "replay:demo?speed=0", name)
    road.step("label", "tactile-rt", "label", *names, "set", "--by-name")
    network = ["--encoder", "gru", "--set", "attender=none", "--set", "decoder=linear"]
    few = ["--set", "batch=2", "--set", "updates=20"]
    road.step("train", "tactile-rt", "train", "set", "run", *network, *few)
    road.step("export", "tactile-rt", "export", "run/best.pt", "model.onnx")
    road.step("evaluate", "tactile-rt", "eval", "model.onnx", "set")


def _dbc(road: Road) -> None:
    for name in ("can_dbc.toml", "can_dbc.dbc"):
        shutil.copy(ROOT / "docs" / "codecs" / name, road.folder)
    device = "tactile-rt emulate can-dbc --set mapping=can_dbc.toml --wire slcan --link pad"
    read = "tactile-rt hz 'can:slcan:pad?codec=can-dbc&mapping=can_dbc.toml' --seconds 2"
    until = "until test -e pad; do sleep 0.1; done"
    script = f"{device} > device.log & timeout 60 sh -c '{until}'; {read}; said=$?; kill $!; "
    road.step("read", "sh", "-c", f"{script}exit $said", says=["pad: ", " Hz"])


def _import(road: Road) -> None:
    road.step("make a bag", "python", "-c", BAG)
    road.step(
        "import it", "tactile-rt", "import", "run.bag", "--topic", "/wrench",
        says=["run.mcap: 100 samples in, 100 intact"],
    )  # fmt: skip


def _publish(*kinds: str) -> Callable[[Road], None]:
    def walk(road: Road) -> None:
        tables = "".join(f'[[publisher]]\nkind = "{kind}"\n' for kind in kinds)
        (road.folder / "robot.toml").write_text(PUBLISHERS + tables)
        said = [f"publisher.{kind} running" for kind in kinds]
        road.step("publish", "tactile-rt", "run", "robot.toml", "--seconds", "3", says=said)

    return walk


def _onboard(road: Road) -> None:
    size = road.size_mb()
    if size > LARGEST_MB:
        raise Failed(f"{size:.0f} MB are installed, more than {LARGEST_MB:g}")
    road.tell(f"{size:.0f} MB are installed, without bytecode")
    _publish("zmq", "zenoh", "foxglove")(road)


def _convert(*arguments: str) -> Callable[[Road], None]:
    def walk(road: Road) -> None:
        road.step("record", "tactile-rt", "record", "replay:demo?speed=0", "run.mcap")
        road.step("convert", "tactile-rt", "convert", "run.mcap", *arguments)

    return walk


def _align(road: Road) -> None:
    road.step("example", "tactile-rt", "align", "example", "brain")
    build = ["--out", "benchmark.json", "--bootstraps", "20"]
    road.step("build", "tactile-rt", "align", "build", "brain/recordings", *build)
    model = "brain/models/another-mouse.npz"
    road.step("score", "tactile-rt", "align", "score", model, "--benchmark", "benchmark.json")


def _cluster(road: Road) -> None:
    settings = ("per_category=3", "validation=1", "test=1")
    few = [word for one in settings for word in ("--set", f"objects.{one}")]
    recipe = ["--recipe", "mouse12", *few, "--set", "sweeps.draws=1", "--split", "test"]
    road.step("sweep", "tactile-rt", "sweep", "set", *recipe, "--ray", "auto")


EXTRAS: dict[str, Callable[[Road], None]] = {
    "sim": _sim,
    "gym": _gym,
    "view": _view,
    "train": _train,
    "dbc": _dbc,
    "import": _import,
    "publish": _publish("zmq", "zenoh", "foxglove"),
    "ros2": _publish("ros2"),
    "lerobot": _convert("set", "--to", "lerobot"),
    "hdf5": _convert("run.h5"),
    "onboard": _onboard,
    "align": _align,
    "cluster": _cluster,
}


def walk_extra(road: Road, wheel: Path, extra: str) -> None:
    """Walk the road of an extra.

    Raises:
        Failed: a step does not do what it should.
    """
    # The CPU build, where several gigabytes of CUDA are not wanted.
    first = ["torch==2.13.0"] if extra == "train" else []
    road.install(*first, f"{wheel}[{extra}]")
    EXTRAS[extra](road)
