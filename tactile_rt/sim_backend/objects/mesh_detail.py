"""Settings for cutting a mesh into convex pieces."""

from dataclasses import asdict, dataclass

from tactile_rt.core.errors import ConfigError

SIZE_MM = 40.0  # largest extent at which distances on meshes are given
UP = ("y", "z")


@dataclass(frozen=True, kw_only=True)
class MeshDetail:
    """Settings for cutting a mesh into convex pieces.

    Attributes:
        surface_error_mm: The largest distance allowed between pieces and mesh, mm, for a largest
            extent of 40 mm; also about half the thickness of the plates that an open surface
            becomes.
        max_pieces: The largest number of pieces; if it does not suffice, the distance is larger
            (and measured).
        hull: Whether to use a single piece, the convex hull; its distance is measured but not
            bounded.
        up: The axis of the file that points up, "y" or "z"; if empty, that of its format (y in
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
        """Return the settings that differ from the defaults."""
        usual = asdict(STANDARD)
        return {k: getattr(self, k) for k in usual if getattr(self, k) != usual[k]}


STANDARD = MeshDetail()
