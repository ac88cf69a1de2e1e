"""Sets of real shapes with makers or kinds held out: other splits of sweeps that are there.

A *view* of a set is a set with a manifest of its own, and links to the other's sweeps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tactile_rt.sets.manifest import SKIPPED, SPLITS, SweepManifest, object_path
from tactile_rt.sim_backend.objects.object_sets import Origin, open_objects

FOLDS = {  # makers whose things are held out together
    "sweethome3d": ("sweethome3d",),
    "quaternius": ("quaternius",),
    "kenney+gazebo+aws": ("kenney", "gazebo", "aws"),
    "m3": ("m3",),
    "kaykit+scans": ("kaykit", "scans"),
}
EVERYONE, OTHER = "all", "other"
# Of `other`: what no network may learn from.
TEST_KINDS = ("clothes", "house", "person", "rock", "shelf", "tool", "tower", "vehicle")
MAKER, KINDS = "maker", "kinds"  # splits: all things of the makers held out, of the kinds held out


def hold_out_kinds(manifest: SweepManifest) -> SweepManifest:
    """Put the kinds that are for testing only in a split of their own."""

    def held(name: str) -> bool:
        return manifest.category(name) == OTHER and manifest.kind_of.get(name) in TEST_KINDS

    split = {side: tuple(n for n in manifest.split[side] if not held(n)) for side in SPLITS}
    return replace(manifest, split=split | {KINDS: tuple(filter(held, manifest.names(SPLITS)))})


def hold_out_makers(
    manifest: SweepManifest, origins: Mapping[str, Origin], makers: Sequence[str]
) -> SweepManifest:
    """Put all things of some makers in a split of their own.

    What is like one of them is left out elsewhere.

    Args:
        origins: of the objects, by name.
    """
    group = {n: (manifest.category(n), origins[n].shape or n) for n in manifest.names()}
    held = tuple(n for n in manifest.names() if origins[n].maker in makers)
    like = {group[name] for name in held}
    split = {
        side: tuple(n for n in names if group[n] not in like)
        for side, names in manifest.split.items()
    }
    return replace(manifest, split=split | {MAKER: held})


def read_origins(objects: Path) -> dict[str, Origin]:
    """Origins of a folder's objects, by the names that sets have for them."""
    return {n.replace("/", "-"): one for n, one in open_objects(objects).origins.items()}


def write_views(source: Path, origins: Mapping[str, Origin], views: Path) -> None:
    """Write a view of a set for all makers, and one for each fold.

    Args:
        origins: of the objects, by name.
        views: folder of folders, `EVERYONE` and those of `FOLDS`.
    """
    whole = hold_out_kinds(SweepManifest.read(source))
    manifests = {EVERYONE: whole}
    for fold, makers in FOLDS.items():
        manifests[fold] = hold_out_makers(whole, origins, makers)
    for name, manifest in manifests.items():
        manifest.write(views / name)
        files = (object_path(source, one) for one in manifest.names())
        for there in (*files, source / SKIPPED):
            link = views / name / there.name
            if there.exists() and not link.exists():
                link.symlink_to(there.resolve())
