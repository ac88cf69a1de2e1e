"""The same kinds drawn more freely, as they differ between makers, and in games and toys.

The builders of `shapes` draw each kind from one plan, which a network learns. Those here draw the
plan, too: the number of legs, with or without back, handle or roof, round or square, parts grown
into one another or left out. A kind without a builder here is built by `shapes`.
"""

from collections.abc import Callable

from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.shapes.varied import (
    furniture,
    outdoors,
    tools,
    vehicles,
    vessels,
)

__all__ = ["BUILDERS"]

BUILDERS: dict[str, Callable[[Generator], list[Trimesh]]] = {
    builder.__name__: builder
    for builder in (
        tools.birdcage,
        vessels.bottle,
        vessels.bowl,
        outdoors.cactus,
        vehicles.car,
        outdoors.castle,
        furniture.chair,
        tools.dumbbell,
        tools.gear,
        outdoors.grapes,
        tools.hourglass,
        outdoors.house,
        furniture.ladder,
        furniture.lamp,
        vessels.mug,
        outdoors.mushroom,
        outdoors.pagoda,
        vehicles.plane,
        outdoors.pumpkin,
        outdoors.snowman,
        tools.spring,
        furniture.table,
    )
}
