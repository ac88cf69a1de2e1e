"""How finely a mesh is told apart into pieces, and which way is up in it."""

from dataclasses import asdict, dataclass

from tactile_rt.core.errors import ConfigError

SIZE_MM = 40.0  # largest extent at which distances on meshes are given
UP = ("y", "z")


@dataclass(frozen=True, kw_only=True)
class MeshDetail:
    """How a mesh becomes convex pieces.

    Attributes:
        surface_error_mm: The largest distance allowed between pieces and mesh, mm, where the
            largest extent of the mesh is 40 mm; about so far the plates of an open surface reach to
            either side of it, too.
        max_pieces: The largest number of pieces; where it does not suffice, the distance is larger
            (and known).
        hull: Whether to take one piece only, the convex hull; its distance is measured but not
            bounded.
        up: The axis of the file that points up, "y" or "z"; empty: as its format has it (y in
            glTF), else z.
    """

    surface_error_mm: float = 0.1
    max_pieces: int = 1024
    hull: bool = False
    up: str = ""

    def __post_init__(self) -> None:
        if not 0.01 <= self.surface_error_mm <= SIZE_MM / 4:
            raise ConfigError(
                f"surface_error_mm must be 0.01 to {SIZE_MM / 4:g}, at a size of {SIZE_MM:g} mm, "
                f"not {self.surface_error_mm:g}"
            )
        if self.max_pieces < 1:
            raise ConfigError(f"max_pieces must be 1 or more, not {self.max_pieces}")
        if self.up not in ("", *UP):
            raise ConfigError(f"up must be one of {', '.join(UP)}, not {self.up!r}")

    def differing(self) -> dict[str, float | int | bool | str]:
        """What of it is not as it is by default."""
        usual = asdict(STANDARD)
        return {k: getattr(self, k) for k in usual if getattr(self, k) != usual[k]}


STANDARD = MeshDetail()
