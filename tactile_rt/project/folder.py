"""The folder of a project: an array, the objects that touch it, a robot and a model.

array.toml       the whiskers of the array, and the sensor that reads them
array.json       the same array as JSON, which every device and model must match
sweeps.toml      the objects that touch the array, and how they pass it
robot.toml       the device and the model for `tactile-rt run robot.toml`
test_robot.py    a test of the robot's own code, driven by an emulated device
README.md        the commands, in order
model.onnx, report/, build/  output of `tactile-rt make`
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from types import MappingProxyType
from urllib.parse import quote, urlencode

from tactile_rt.classifier.model_file import read_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.settings import no_such, read_text, split_url
from tactile_rt.daemon.loading import load_config
from tactile_rt.drivers.codec import codec_class
from tactile_rt.project.placing import place_objects
from tactile_rt.sets.sensor_faults import LARGEST
from tactile_rt.sim_backend.arrays.files import (
    ARRAY_FILES,
    ROBOTS,
    load_animals,
    read_animals,
    robot_text,
)
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.catalogue import CATEGORIES, added_categories
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.transducer import device_spec, sensor_drift, sensor_of
from tactile_rt.sim_backend.world import PROFILES

RANGES = {"N": "range_n", "N m": "range_nm"}  # options of the native codec
KINDS = ("bottle", "car", "chair", "gear", "mug", "pumpkin")
NO_NAME = re.compile(r"[^\w.+-]+")  # characters with a meaning of their own in a URL or TOML
FILES = ("sweeps.toml", "robot.toml", "test_robot.py", "README.md")
# mm/s, for objects of 40 mm. Larger objects move faster: a window then covers as much of the array.
SPEEDS = (28, 40)


@dataclass(frozen=True)
class DeviceLine:
    """Serial port or CAN bus of a project's device, and the codec that reads it.

    Attributes:
        wire: ``serial`` or ``can``.
        port: The serial port, or INTERFACE:CHANNEL of a bus.
    """

    wire: str
    port: str
    codec: str
    options: dict[str, str]


class Project:
    """Project folder: an array, its sweeps, its robot, and the model made for them.

    Attributes:
        array: The file that describes the array, array.toml.
        model: The model file that `make` writes.
        build: The folder of intermediate results.
        report: The folder of the report card.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ConfigError(f"no folder {folder}: begin with `tactile-rt new {folder}`")
        for name in ("array.toml", "sweeps.toml"):
            if not (folder / name).is_file():
                raise ConfigError(
                    f"{folder} is no project, it has no {name}: begin one with "
                    "`tactile-rt new` in a folder of its own"
                )
        self.folder = folder
        self.array, self.model = folder / "array.toml", folder / "model.onnx"
        self.build, self.report = folder / "build", folder / "report"

    def write_spec(self) -> None:
        """Write the array's spec, which devices and models must match, into array.json."""
        spec = device_spec(load_animals(str(self.array)))
        _write(self.folder / "array.json", spec.to_json())

    def recipe(self) -> SweepRecipe:
        """Read sweeps.toml; its numbers of objects and sweeps are upper limits."""
        recipe = read_recipe(str(self.folder / "sweeps.toml"), self.folder)
        if Path(recipe.array).resolve() != self.array.resolve():
            raise ConfigError(f'{self.folder / "sweeps.toml"}: array must be "array.toml"')
        return recipe

    def source_url(self, objects: Sequence[str], seed: int = 0, **options: object) -> str:
        """Return the ``sim:`` URL of a source that sweeps these objects past the array.

        The sweeps are as in sweeps.toml, the samples as the array's device measures them.
        """
        meshes = choose_objects(self.recipe().objects).mesh_options
        recipe = self.folder / "sweeps.toml"
        names = ",".join(name.replace(",", "%2C") for name in objects)
        fields = {"objects": names, "recipe": recipe, "seed": seed, **meshes, **options}
        query = urlencode(fields, safe=",/", quote_via=quote)  # our URLs do not read + as a space
        return f"sim:{quote(str(self.array))}?{query}"

    def unseen(self) -> tuple[str, ...]:
        """List the objects that the model was not trained on, named as in ``sim:`` URLs.

        Without a model, these are the test objects of sweeps.toml.
        """
        objects = choose_objects(self.recipe().objects)
        names: Sequence[str] = objects.split["test"]
        if self.model.exists():
            names = list(map(str, read_model(self.model)[0].provenance.get("unseen_objects", [])))
        return tuple(objects.target(name) for name in names)

    def full_scale(self, codec: str) -> dict[str, str]:
        """Return the sensor's ranges as options of the native codec; {} for other codecs."""
        sensor = sensor_of(load_animals(str(self.array)))
        if codec != "native" or sensor is None:
            return {}
        largest: dict[str, float] = {}
        for channel in sensor.channels:
            name = RANGES.get(channel.unit, "range_si")
            largest[name] = max(largest.get(name, 0.0), channel.range)
        return {name: f"{value:g}" for name, value in largest.items()}

    def line(self) -> DeviceLine:
        """Return the port or bus, and the codec, of the first source in robot.toml."""
        file = self.folder / "robot.toml"
        url = load_config(file).config.source[0].url
        scheme, target, fields = split_url(url)
        if scheme not in ("serial", "can") or "codec" not in fields:
            raise ConfigError(
                f"{file}: the source {url} is no device to emulate: give it a URL as "
                "serial:///tmp/whiskers?codec=native"
            )
        known = codec_class(scheme, fields["codec"]).Options.__dataclass_fields__
        options = {name: value for name, value in fields.items() if name in known}
        return DeviceLine(scheme, target.removeprefix("//"), fields["codec"], options)

    def spoken(
        self, codec: str | None = None, options: Mapping[str, str] = MappingProxyType({})
    ) -> tuple[str, dict[str, str]]:
        """Return the name of the device's codec, and the codec's options.

        Args:
            codec: name that replaces the codec of robot.toml.
            options: options that replace those of robot.toml, or are added to them.
        """
        line = self.line()
        codec = codec or line.codec
        own = line.options if codec == line.codec else {}
        return codec, {**own, **self.full_scale(codec), **options}


def new_project(folder: Path, array: str = "", kinds: Sequence[str] = KINDS) -> Project:
    """Create a project in a new or an empty folder.

    Args:
        array: name of an array, or a .toml file. The file, also of a named robot's array, is
            copied. Empty for an example to edit: eight nylon whiskers on a plate.

    Raises:
        ConfigError: the folder is not empty, the array or a category is unknown, or the array
            needs more than one file.
    """
    templates = resources.files("tactile_rt.project") / "templates"
    with resources.as_file(templates / "array.toml.txt") as example:
        array_text = _make_array_text(array, folder) if array else example.read_text("utf-8")
        animals = load_animals(array) if array else read_animals(example)
    spec = device_spec(animals)
    known = (*CATEGORIES, *added_categories())
    for kind in kinds:
        if kind not in known:
            raise ConfigError(no_such("category", kind, known))
    if len(set(kinds)) < len(kinds) or len(kinds) < 2:
        raise ConfigError("--classes takes two or more categories, each once")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder} is not empty: name a new folder")
    placing = place_objects(animals, kinds)
    slow, fast = (f"{speed * placing.size_mm / Sweep.size_mm:.3g}" for speed in SPEEDS)
    name = NO_NAME.sub("-", folder.resolve().name)
    words = {
        "name": name,
        "kind": kinds[0],
        "kinds": ", ".join(f'"{kind}"' for kind in kinds),
        "near": f"{placing.distance_mm[0]:.3g}",
        "far": f"{placing.distance_mm[1]:.3g}",
        "low": f"{placing.height_mm[0]:g}",
        "high": f"{placing.height_mm[1]:g}",
        "usual": f"{placing.size_mm:g}",
        "touching": f"{100 * placing.touching:.0f}",
        "slow": slow,
        "fast": fast,
        "offset": f"{min(sensor_drift(animals, SweepRecipe.period_ms), LARGEST):.2g}",
        "profiles": ", ".join(PROFILES),
        "whiskers": str(len(spec.elements)),
        "link": f"/tmp/{name}",
        "device": ROBOTS.get(array, "codec=native"),
    }
    folder.mkdir(parents=True, exist_ok=True)
    texts = {name: (templates / f"{name}.txt").read_text("utf-8") for name in FILES}
    try:
        for name, text in texts.items():
            _write(folder / name, Template(text).substitute(words))
        _write(folder / "array.toml", array_text)
        project = Project(folder)
        project.write_spec()
    except OSError:  # such as a full disk: leave the folder empty for another try
        for name in (*texts, "array.toml"):
            (folder / name).unlink(missing_ok=True)
        raise
    return project


def _make_array_text(array: str, folder: Path) -> str:
    if array in ROBOTS:
        return robot_text(array)
    path = Path(array)
    if path.suffix.lower() not in ARRAY_FILES:
        return (
            "# The array is one that comes with tactile_rt. One of your own is described as in\n"
            "# docs/arrays/robot.toml: its whiskers, and what reads them.\n\n"
            f'[[animal]]\narray = "{array}"\n'
        )
    if path.suffix.lower() == ".csv":
        raise ConfigError(
            f"{array}: a project's array is a .toml file, which can say what reads the whiskers; "
            "copy the columns into [[whisker]] tables as in docs/arrays/robot.toml"
        )
    text = read_text(path)
    try:
        read_animals(folder / "array.toml", text)
    except ConfigError:
        raise ConfigError(
            f"{array}: an [[animal]] names its array by a relative path, which the project's "
            "copy would not find: give the whole path"
        ) from None
    return text


def _write(path: Path, text: str) -> None:
    write_whole(path, lambda file: file.write(text.encode()))
