"""The array that one six-axis force and moment sensor is."""

from tactile_rt.stream import ArraySpec

__all__ = ["six_axis"]


def six_axis(name: str, rate_hz: float) -> ArraySpec:
    """One element at the origin of the frame ``sensor``: fx, fy, fz in N, mx, my, mz in N m."""
    return ArraySpec(
        name=name,
        elements=("sensor",),
        grid=((0, 0),),
        positions=((0.0, 0.0, 0.0),),  # loads are told at the frame's origin
        orientations=((1.0, 0.0, 0.0, 0.0),),
        channels=("fx", "fy", "fz", "mx", "my", "mz"),
        units=("N",) * 3 + ("N m",) * 3,
        rate_hz=rate_hz,
        frame="sensor",
    )
