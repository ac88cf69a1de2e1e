"""`tactile-rt view`: draw a sweep as a picture or a video; `whisk`: simulate whisking."""

import hashlib
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactile_rt.cli.app import app, check_output, needing
from tactile_rt.cli.options import Json, argument, option, set_option
from tactile_rt.cli.tables import progress_bar, share_bar, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import take_sets

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Array = Annotated[str, option("Array: mouse, rat, rat-left, ..., or a file.")]

PICTURE_MS = 4  # between the samples of a picture's traces
FPS = 25
WIDTH = 1280  # pixels


@app.command(epilog="tactile-rt view mug-17 --out sweep.png --camera side")
def view(
    target: Annotated[str, argument("Object to sweep past: mug-17, or a mesh file.")],
    out: Annotated[Path, option("Picture (.png, .jpg) or video (.mp4).")] = Path("sweep.png"),
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
    except (AttributeError, RuntimeError) as error:  # raised by mujoco if it finds no such driver
        if "MUJOCO_GL" not in os.environ:
            raise
        raise ConfigError(f"MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}; unset it") from None
    suffix = film.check_suffix(out)
    if at is not None and suffix not in film.IMAGES:
        raise ConfigError("--at needs a picture: an --out that ends in .png or .jpg")
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


@dataclass(frozen=True)
class Spacing:
    """Options of the stimuli's places, for ``--set``."""

    radius_mm: float = 63.6  # radius of the stimuli's arc, mm
    step_mm: str = "1,1,0"  # vector from a stimulus to the next further one: ``x,y,z``, mm


@app.command(epilog="tactile-rt whisk stimuli.npz --set frequency_hz=8")
def whisk(
    out: Annotated[Path, argument("The .npz to write; a .json is written beside it.")],
    stimulus: Annotated[
        str | None, option("Stimuli: convex-close, ..., comma-separated. Default: all six.")
    ] = None,
    target: Annotated[
        str | None,
        option("Whisk against this object, not the stimuli: mug-3, or a mesh file.", "--object"),
    ] = None,
    array: Array = "mouse",
    trajectory: Annotated[
        Path | None, option("CSV file of the trajectory to follow: time_s, theta_deg.")
    ] = None,
    profile: Annotated[str, option("Accuracy: realtime, dataset (finer), accurate.")] = "dataset",
    sets: Annotated[
        list[str] | None,
        set_option(
            "An option of the whisking, stimuli or object: frequency_hz=10, duration_s=2, "
            "radius_mm=60, position_mm=22,8,0, size_mm=30, hull=true"
        ),
    ] = None,
    json: Json = None,
) -> None:
    """Simulate whisking against surfaces, and store the loads."""
    if out.suffix != ".npz":
        raise ConfigError(f"{out}: name a file that ends in .npz")
    if target is not None and stimulus is not None:
        raise ConfigError("--object and --stimulus exclude each other: name one of them")
    beside = out.with_suffix(".json")
    for file in (out, beside):
        check_output(file)
    if json is not None and json.resolve() == beside.resolve():
        raise ConfigError(f"{json} is written beside {out} by this command: name another")
    with needing("sim"):
        import numpy as np

        from tactile_rt.core.stream.stimuli import STIMULI
        from tactile_rt.sim_backend.arrays.files import load_array
        from tactile_rt.sim_backend.objects.catalogue import load_object
        from tactile_rt.sim_backend.objects.mesh_detail import MeshDetail
        from tactile_rt.sim_backend.stimulus_simulation import Surface, whisk_against, write_input
        from tactile_rt.sim_backend.trajectories import Whisk, base_angles, read_trajectory
        from tactile_rt.sim_backend.whisking import HEAD, WhiskSimulation
        from tactile_rt.sim_backend.whisking_source import Placing, parse_point
        from tactile_rt.sim_backend.world import PROFILES, array_spec
    if profile not in PROFILES:
        raise ConfigError(f"no profile {profile!r}: there are {', '.join(PROFILES)}")
    animal = load_array(array)
    kinds = (Whisk, Placing, Spacing, MeshDetail)
    regular, placing, spacing, mesh = take_sets("whisk", sets or (), *kinds)
    moves, followed = regular, dict[str, str]()
    if trajectory:
        moves = read_trajectory(trajectory, animal.whiskers)
        sha256 = hashlib.sha256(trajectory.read_bytes()).hexdigest()
        followed = {"file": trajectory.name, "sha256": sha256}
    pieces, described = {}, {}
    # The stimuli stand on the right of the head; for an array of the left side, on the left.
    left = all(w.base[0] < 0 for w in animal.whiskers)
    head, mirror = (HEAD.mirror(), np.array([-1.0, 1.0, 1.0])) if left else (HEAD, np.ones(3))
    if target is not None:
        thing = load_object(target, mesh)
        pieces[thing.name] = placing.place(thing, left)
        described[thing.name] = {
            **asdict(placing),
            "position_mm": (mirror * parse_point(placing.position_mm, "position_mm")).tolist(),
        }
    else:
        step = parse_point(spacing.step_mm, "step_mm")
        names = STIMULI if stimulus in (None, "all") else stimulus.split(",")
        for name in dict.fromkeys(n.strip() for n in names):
            surface = Surface.make(name, step, spacing.radius_mm)
            pieces[name] = tuple(corners * mirror for corners in surface.pieces())
            described[name] = {
                **asdict(surface),
                "mirrored": left,
                "facet_error_mm": surface.largest_gap_mm,
            }

    felt = {}
    with progress_bar("whisking") as update:
        for name, corners in pieces.items():
            try:
                simulation = WhiskSimulation(
                    animal.whiskers, moves, PROFILES[profile], corners, head
                )
            except ConfigError as error:
                raise ConfigError(f"{name}: {error}") from None
            update(total=simulation.samples * len(pieces), description=name)
            felt[name] = whisk_against(simulation, lambda n: update(advance=n))
    times = np.arange(simulation.samples, dtype=np.float64) * 1e-3
    parameters: dict[str, Any] = {
        "parameters": described,
        "approximate": target is None,
        "trajectory": followed if trajectory else asdict(moves),
        "head": asdict(head),
        "profile": {"name": profile, **asdict(PROFILES[profile])},
    }
    write_input(
        out,
        felt,
        array_spec(animal.whiskers, animal.name),
        base_angles(moves, times, animal.whiskers),
        parameters,
    )
    results = [
        {
            "stimulus": name, "first_ms": what.first_ms,
            "whiskers": int(what.touch.any(axis=0).sum()),
        }
        for name, what in felt.items()
    ]  # fmt: skip
    told_as_json(results, json)
    for one in results:
        typer.echo(
            f"{one['stimulus']}: first contact at {one['first_ms']} ms, {one['whiskers']} of "
            f"{len(animal.whiskers)} whiskers touch it",
            err=True,
        )
    typer.echo(f"{out} and {beside}: {len(felt)} stimuli", err=True)
