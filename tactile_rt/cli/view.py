"""`tactile-rt view`: a sweep as a picture or as a video."""

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactile_rt.cli.app import app, check_output, needing
from tactile_rt.cli.options import Array, argument, option, set_option
from tactile_rt.cli.tables import progress_bar, share_bar
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import take_sets

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

PICTURE_MS = 4  # between the samples of a picture's traces
FPS = 25
WIDTH = 1280  # pixels


@app.command(epilog="tactile-rt view mug-17 --out sweep.png --camera side")
def view(
    target: Annotated[str, argument("Object to sweep past: mug-17, or a mesh file.")],
    out: Annotated[
        Path, option("Picture (.png, .jpg) or video (.mp4).")
    ] = Path(
        "sweep.png"
    ),
    camera: Annotated[str, option("View: front, side, top or oblique.")] = "oblique",
    at: Annotated[
        float | None, option("Time of a picture, ms. Default: of the largest force.")
    ] = None,
    slow: Annotated[float, option("Slow-motion factor of a video.", min=1, max=40)] = 10.0,
    array: Array = "mouse",
    profile: Annotated[
        str, option("Accuracy: realtime, dataset (finer), accurate, mujoco.")
    ] = "dataset",
    sets: Annotated[
        list[str] | None,
        set_option("An option of the sweep or the mesh: size_mm=30, yaw_deg=45, hull=true"),
    ] = None,
) -> None:
    """Draw a simulated sweep and what the array reads: a picture or a video."""
    check_output(out)
    try:
        with needing("view"):
            from tactile_rt.sim_backend.arrays.files import load_animals
            from tactile_rt.sim_backend.objects.catalogue import load_object
            from tactile_rt.sim_backend.objects.mesh_detail import MeshDetail
            from tactile_rt.sim_backend.sweep import Sweep, usual_distance
            from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
            from tactile_rt.sim_backend.transducer import device_spec, sensor_of
            from tactile_rt.sim_backend.views import film
            from tactile_rt.sim_backend.views.footage import VIEWS, record
            from tactile_rt.sim_backend.world import PROFILES
    except (AttributeError, RuntimeError) as error:  # as mujoco does where it finds no such driver
        if "MUJOCO_GL" not in os.environ:
            raise
        raise ConfigError(f"MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}; unset it") from None
    suffix = film.check_suffix(out)
    if at is not None and suffix not in film.IMAGES:
        raise ConfigError("--at is the moment of a picture: give --out a .png or .jpg")
    if camera not in VIEWS:
        raise ConfigError(f"no camera {camera!r}: there are {', '.join(VIEWS)}")
    if profile not in PROFILES:
        raise ConfigError(f"no profile {profile!r}: there are {', '.join(PROFILES)}")

    animals = load_animals(array)
    usual = {"distance_mm": usual_distance(animals)}
    sweep, mesh = take_sets("view", sets or (), Sweep, MeshDetail, usual=usual)
    thing = load_object(target, mesh)
    spec, sensor = device_spec(animals), sensor_of(animals)
    simulation = SweepSimulation(animals, thing, sweep, PROFILES[profile], whole=True)
    if at is not None and not 0 <= at <= simulation.duration_ms:
        raise ConfigError(f"--at {at:g}: the sweep lasts {simulation.duration_ms:.0f} ms")
    if not simulation.touches:
        none = f"{thing.name} passes without touching: --set height_mm or distance_mm"
        typer.echo(none, err=True)
    period = PICTURE_MS if suffix in film.IMAGES else max(1, round(1000 / (FPS * slow)))
    with share_bar("simulating") as tell:
        footage = record(simulation, spec, period, tell, sensor)
    detail = f"{camera} view · {thing.name} moves along -y"
    if suffix not in film.IMAGES:
        detail += f" · {FPS * period / 1000:.2g} x real speed"
    title = (
        f"{thing.name[:40]}, {sweep.size_mm:g} mm large, sweeps past the {len(spec.elements)} "
        f"whiskers of {spec.name[:40]} at {sweep.speed_mm_s:g} mm/s"
    )
    with closing(film.Film(footage, camera, title, detail, WIDTH)) as shown:
        if suffix in film.IMAGES:
            moment = footage.strongest if at is None else footage.at(at)
            film.write_image(out, shown.picture(moment))
            return
        with progress_bar("drawing", total=len(footage)) as update:

            def pictures() -> Iterator["NDArray[np.uint8]"]:
                for picture in shown:
                    yield picture
                    update(advance=1)

            film.write_video(out, pictures(), FPS)
