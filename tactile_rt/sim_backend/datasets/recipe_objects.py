"""The objects of a recipe: their names, their split, and their loading by name."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, ClassVar

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import no_such
from tactile_rt.sets.manifest import OUTLIERS, SPLITS, WITHHELD
from tactile_rt.sets.splits import split_by_object
from tactile_rt.sim_backend.datasets.recipes import VARIED_SHAPES, ObjectChoice
from tactile_rt.sim_backend.objects import catalogue as shapes
from tactile_rt.sim_backend.objects.catalogue import VARIED, TactileObject, load_object

if TYPE_CHECKING:
    from tactile_rt.sim_backend.objects.object_sets import ObjectSet

PER_WITHHELD = 12


@dataclass(frozen=True)
class ShapeObjects:
    """The parametric objects that a recipe chooses, and their split.

    Raises:
        ConfigError: a category does not exist or is too small for the split.
    """

    choice: ObjectChoice
    # each category has one kind, all objects can be made, and none is a mesh: see `MeshObjects`
    kind_of: ClassVar[dict[str, str]] = {}
    skipped: ClassVar[dict[str, str]] = {}
    mesh_options: ClassVar[dict[str, Any]] = {}

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Names of the classes; a label is an index into them."""
        known = (*shapes.CATEGORIES, *shapes.WITHHELD, *shapes.added_categories())
        _check_categories(self.choice.categories, known)
        unknown = (*self.choice.withheld, *self.choice.outliers)
        return self.choice.categories or tuple(c for c in shapes.CATEGORIES if c not in unknown)

    @cached_property
    def withheld(self) -> tuple[str, ...]:
        """Names of the categories withheld from training, for open-set tests."""
        unknown = (*self.choice.withheld, *self.choice.outliers)
        known = (*shapes.CATEGORIES, *shapes.WITHHELD, *shapes.OUTLIERS)
        _check_categories(unknown, (*known, *shapes.added_categories()))
        return self.choice.withheld or (shapes.WITHHELD if self.choice.per_withheld else ())

    @cached_property
    def split(self) -> dict[str, tuple[str, ...]]:
        """Names of the objects in each split."""
        choice = self.choice
        validation, test = int(choice.validation), int(choice.test)
        if choice.per_category - validation - test < 1:
            raise ConfigError(
                f"{choice.per_category} objects cannot be split with {validation} for validation "
                f"and {test} for test: each side needs at least one"
            )
        split = split_by_object(
            [self._prefix + c for c in self.categories], choice.per_category, validation, test
        )
        count = choice.per_withheld or PER_WITHHELD
        for key, categories in ((WITHHELD, self.withheld), (OUTLIERS, choice.outliers)):
            if categories:
                split[key] = tuple(
                    f"{self._prefix}{c}-{i}" for i in range(count) for c in categories
                )
        return split

    @property
    def _prefix(self) -> str:
        """Prefix of all object names."""
        return VARIED if self.choice.source == VARIED_SHAPES else ""

    @property
    def category_of(self) -> dict[str, str]:
        """Category by object name, for names that do not give it."""
        if not self._prefix:
            return {}
        names = chain.from_iterable(self.split.values())
        return {name: name[len(self._prefix) : name.rindex("-")] for name in names}

    def load(self, name: str) -> TactileObject:
        """Load an object by its name."""
        return load_object(name)

    def target(self, name: str) -> str:
        """Return the name by which a ``sim:`` URL finds the object: its own."""
        return name


@dataclass(frozen=True)
class MeshObjects:
    """The objects that a recipe chooses from a folder of meshes, and their split.

    `object_sets` reads the folder. The split depends on object names alone, so that few change
    sides when the folder grows. Objects of one shape in its table stay together, and count as one.

    Raises:
        ConfigError: no such folder, or a category is missing or too small for the split.
    """

    choice: ObjectChoice

    @cached_property
    def _set(self) -> "ObjectSet":
        # Imported here, since it cuts meshes and is slow to import.
        from tactile_rt.sim_backend.objects.object_sets import open_objects

        return open_objects(self.choice.source, self.choice.mesh, self.choice.labels)

    @cached_property
    def _names(self) -> dict[str, str]:
        """Name in the folder (``category/object``), by name in the set (``category-object``)."""
        names = {name.replace("/", "-"): name for name in self._set.names}
        if len(names) < len(self._set.names):
            raise ConfigError(
                f"{self.choice.source}: names of two objects differ only by / and -: rename one"
            )
        return names

    @cached_property
    def _by_category(self) -> dict[str, list[list[str]]]:
        """Groups of objects of one shape, by category, in a fixed shuffled order."""
        origins, omit, only = self._set.origins, self.choice.without_source, self.choice.only_source
        sources = {name: origin.source for name, origin in origins.items()}
        for source in filter(None, (omit, only)):
            if source not in sources.values():
                raise ConfigError(no_such("source", source, sorted(set(sources.values()))))
        alike: dict[str, dict[str, list[str]]] = {}
        for name, own in sorted(self._names.items()):
            if not omit or sources.get(own) != omit:
                shapes = alike.setdefault(self._set.categories[own], {})
                shape = origins[own].shape if own in origins else ""
                shapes.setdefault(shape or own, []).append(name)
        found = {}
        for category, shapes in alike.items():
            groups = list(shapes.values())
            if only:
                groups = [g for g in groups if {sources.get(self._names[n]) for n in g} == {only}]
            if groups:  # in a shuffled order that is the same on every machine
                found[category] = sorted(groups, key=lambda g: (zlib.crc32(g[0].encode()), g))
        return found

    @cached_property
    def categories(self) -> tuple[str, ...]:
        """Names of the classes; a label is an index into them."""
        known = tuple(sorted(self._by_category))
        _check_categories(self.choice.categories, known)
        unknown = (*self.withheld, *self.choice.outliers)
        return self.choice.categories or tuple(c for c in known if c not in unknown)

    @cached_property
    def withheld(self) -> tuple[str, ...]:
        """Names of the categories withheld from training, for open-set tests."""
        unknown = (*self.choice.withheld, *self.choice.outliers)
        _check_categories(unknown, tuple(sorted(self._by_category)))
        return self.choice.withheld

    @cached_property
    def split(self) -> dict[str, tuple[str, ...]]:
        """Names of the objects in each split."""
        sides: dict[str, list[str]] = {split: [] for split in SPLITS}
        for category in self.categories:
            groups = self._by_category[category][: self.choice.per_category or None]
            if self.choice.only_source:
                sides["test"] += chain.from_iterable(groups)
                continue
            validation, test = (
                _resolve_count(n, len(groups)) for n in (self.choice.validation, self.choice.test)
            )
            train = len(groups) - validation - test
            if train < 1:
                raise ConfigError(
                    f"{self.choice.source}: {category} has {len(groups)} objects, too few to hold "
                    f"out {validation} for validation and {test} for test: leave it out of "
                    "objects.categories, or hold out fewer"
                )
            ends = (0, train, train + validation, len(groups))
            for side, (start, stop) in zip(SPLITS, pairwise(ends), strict=True):
                sides[side] += chain.from_iterable(groups[start:stop])
        split = {key: tuple(names) for key, names in sides.items()}
        count = self.choice.per_withheld or None
        for key, categories in ((WITHHELD, self.withheld), (OUTLIERS, self.choice.outliers)):
            if categories:
                chosen = (self._by_category[category][:count] for category in categories)
                split[key] = tuple(chain.from_iterable(chain.from_iterable(chosen)))
        return split

    @property
    def category_of(self) -> dict[str, str]:
        """Category by object name."""
        names = chain.from_iterable(self.split.values())
        return {name: self._set.categories[self._names[name]] for name in names}

    @property
    def kind_of(self) -> dict[str, str]:
        """Kind by object name, for objects whose kind the folder's table gives."""
        names, origins = chain.from_iterable(self.split.values()), self._set.origins
        known = {name: origins[own].kind for name in names if (own := self._names[name]) in origins}
        return {name: kind for name, kind in known.items() if kind}

    @property
    def skipped(self) -> dict[str, str]:
        """Reasons why objects cannot be used, by name, as found so far."""
        return dict(self._set.skipped)

    def load(self, name: str) -> TactileObject:
        """Load an object by its name."""
        return self._set.load(self._names[name])

    def target(self, name: str) -> str:
        """Return the path of the object's mesh file, for a ``sim:`` URL."""
        return str(self._set.path(self._names[name]))

    @property
    def mesh_options(self) -> dict[str, Any]:
        """Options of a ``sim:`` URL that cut mesh files into the same pieces."""
        return self._set.detail.differing()


def choose_objects(choice: ObjectChoice) -> ShapeObjects | MeshObjects:
    """Return the objects that a recipe chooses."""
    return ShapeObjects(choice) if choice.generated else MeshObjects(choice)


def _resolve_count(number: float, total: int) -> int:
    """Return a whole count: `number`, or for a fraction that share of `total` (least 1)."""
    return max(1, round(number * total)) if 0 < number < 1 else int(number)


def _check_categories(names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(no_such("category", name, known))
