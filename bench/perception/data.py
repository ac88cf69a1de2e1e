"""The data of the benchmark: what the mouse's whiskers felt of real things, in one small file.

Loads are stored in steps of a fifth of the rated noise, which no model can tell from none; what is
in the file is the data, to the bit, whoever runs the benchmark on whatever machine. `make` has made
it from `recipes/` and the list of real objects.

    python -m bench.perception.data FILE    # what is in it: objects by kind, source and licence
"""

import hashlib
import io
import lzma
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from bench.perception.folds import KINDS, hold_out_makers
from tactile_rt.models.datasets import SweepSet, join_sets
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD, SweepManifest
from tactile_rt.sets.objects import Sweeps
from tactile_rt.sim_backend.objects.object_sets import Origin

NAME, VERSION = "realtouch", 1
FILE = Path(__file__).parent / "data" / f"{NAME}-{VERSION}.xz"
SHAPES_FILE = FILE.with_name(f"{NAME}-2.xz")
SOURCE = "source"  # known kinds from a source that no other split has anything of
SPLITS = ("train", "validation", "test", SOURCE, OUTLIERS, WITHHELD, KINDS)
STEP = 0.2  # of the rated noise
BLOCK = 16  # sweeps that a processor's cache holds


class BenchmarkObject(Origin, frozen=True, kw_only=True, omit_defaults=True):
    """Where an object is from, of what category it is, and on which side."""

    category: str
    split: str


@dataclass(frozen=True)
class Portion:
    """Some of the file's sweeps.

    Attributes:
        split: The split that they go to.
        folder: The sweep set that they come from.
        there: Their split in that set.
        wide: Whether the objects lie in any way, and are of any size and speed.
        most: The number of sweeps of each object that are taken; 0: all.
    """

    split: str
    folder: Path
    there: str
    wide: bool = False
    most: int = 0

    def read(self) -> SweepSet:
        """Its sweeps, an object's first ones."""
        data = SweepSet.read(self.folder, self.there)
        _, begins, counts = np.unique(data.sweeps.objects, return_index=True, return_counts=True)
        place = np.arange(len(data.sweeps)) - np.repeat(np.sort(begins), counts[begins.argsort()])
        return data[place < (self.most or len(place))]


@dataclass(frozen=True)
class Data:
    """The benchmark's data.

    Attributes:
        sets: The sweeps of every split of `SPLITS`, labelled by `kinds`; -1 where they have none.
        wide: The same objects of the splits "test" and "source" in the wide world.
        origins: Kind, split, source and licence of every object.
        digest: SHA-256 of the file.
    """

    sets: dict[str, SweepSet]
    wide: dict[str, SweepSet]
    origins: dict[str, BenchmarkObject]
    digest: str

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The known kinds, in the order of their labels."""
        return self.sets["train"].manifest.categories

    def without_makers(self, makers: Sequence[str]) -> "Data":
        """The same with all objects of some makers in a split of their own, `MAKER`."""
        whole = join_sets([one for one in self.sets.values() if len(one.sweeps)])
        split = hold_out_makers(self.sets["train"].manifest, self.origins, makers).split
        sets = {
            side: whole[np.flatnonzero(np.isin(whole.sweeps.objects, names))]
            for side, names in split.items()
            if names
        }
        return replace(self, sets=sets, wide={})


def pack(parts: Sequence[Portion], origins: Mapping[str, Origin]) -> bytes:
    """The file's content.

    Args:
        parts: what it is made of, the training split first.
        origins: by the name of the object.
    """
    manifest = SweepManifest.read(parts[0].folder)
    step = (manifest.limits.noise * STEP).astype(np.float64)
    values, objects, wide, told = [], [], [], {}
    for part in parts:
        data = part.read()
        wide.append(np.full(len(data.sweeps), part.wide))
        values.append(np.round(data.sweeps.values / step).astype(np.int32))
        objects.append(data.sweeps.objects)
        for name in dict.fromkeys(data.sweeps.objects.tolist()):
            of = {field: getattr(origins[name], field) for field in Origin.__struct_fields__}
            category = data.manifest.category(name)
            told[name] = BenchmarkObject(category=category, split=part.split, **of)
    steps = np.diff(np.concatenate(values), axis=1, prepend=0)
    if np.abs(steps).max() > np.iinfo(np.int16).max:
        raise ValueError("a load rises by more than 16 bits hold")
    # whisker by whisker: what one channel does in time is what compresses
    arrays = {
        "steps": np.ascontiguousarray(steps.astype(np.int16).transpose(0, 2, 3, 1)),
        "objects": np.concatenate(objects),
        "wide": np.concatenate(wide),
        "step": step,
        "manifest": np.frombuffer(msgspec.json.encode(replace(manifest, split={}, category_of={})),
                                  dtype=np.uint8),
        "origins": np.frombuffer(msgspec.json.encode(told), dtype=np.uint8),
    }  # fmt: skip
    raw = io.BytesIO()
    np.savez(raw, **arrays)
    return lzma.compress(raw.getvalue(), preset=9)


def load(path: Path = FILE) -> Data:
    """Read the data."""
    content = path.read_bytes()
    with np.load(io.BytesIO(lzma.decompress(content))) as arrays:
        steps, objects, step, wide = (arrays[k] for k in ("steps", "objects", "step", "wide"))
        manifest = msgspec.json.decode(arrays["manifest"].tobytes(), type=SweepManifest)
        origins = msgspec.json.decode(arrays["origins"].tobytes(), type=dict[str, BenchmarkObject])
    values = np.empty((len(steps), steps.shape[3], *steps.shape[1:3]), np.float32)
    for at in range(0, len(steps), BLOCK):
        block = steps[at : at + BLOCK].transpose(0, 3, 1, 2).cumsum(axis=1, dtype=np.int32)
        values[at : at + BLOCK] = block * step
    split = {s: tuple(n for n, o in origins.items() if o.split == s) for s in SPLITS}
    category_of = {name: origin.category for name, origin in origins.items()}
    manifest = replace(manifest, split=split, category_of=category_of)
    known = manifest.categories
    labels = {n: known.index(o.category) if o.category in known else -1 for n, o in origins.items()}
    limits = manifest.limits

    def taken(name: str, world: bool) -> SweepSet:
        at = np.flatnonzero(np.isin(objects, list(split[name])) & (wide == world))
        own: NDArray[np.str_] = objects[at]
        numbers = np.array([labels[o] for o in own.tolist()], dtype=np.int64)
        return SweepSet(manifest, Sweeps(values[at], numbers, own), limits.noise, limits.floor)

    sets = {name: taken(name, False) for name in SPLITS}
    everywhere = {name: taken(name, True) for name in ("test", SOURCE)}
    return Data(sets, everywhere, origins, hashlib.sha256(content).hexdigest())


def main() -> int:
    """Print what the file holds."""
    data = load(Path(sys.argv[1]) if len(sys.argv) > 1 else FILE)
    for split in SPLITS:
        mine = [o for o in data.origins.values() if o.split == split]
        if not mine:
            continue
        print(f"{split}: {len(data.sets[split].sweeps)} sweeps of {len(mine)} objects")  # noqa: T201
        kinds = Counter(o.category for o in mine)
        print("   ", ", ".join(f"{k} {n}" for k, n in sorted(kinds.items())))  # noqa: T201
        for (source, licence), n in sorted(Counter((o.source, o.licence) for o in mine).items()):
            print(f"    {n} of {source}, {licence}")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
