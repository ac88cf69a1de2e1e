"""`tactile-rt grid`: many networks, each tuned alike and trained to its end."""

from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app, check_folder, needing
from tactile_rt.cli.options import Accelerator, Json
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import told_as_json


@app.command(epilog="tactile-rt grid wide24 grid --processes 2")
def grid(
    plan: Annotated[str, typer.Argument(help="TOML file, or a shipped plan: wide24, wide24-full.")],
    folder: Annotated[Path, typer.Argument(help="Output folder; finished tasks are kept.")],
    processes: Annotated[int, typer.Option(min=1, help="Networks to train in parallel.")] = 2,
    accelerator: Accelerator = "cpu",
    json: Json = None,
) -> None:
    """Train and compare many networks, each tuned alike.

    A plan combines encoders, attenders and objectives. An interrupted grid continues. FOLDER gets
    results.json, results.md and task_performance.png.
    """
    from tactile_rt.models.grid.outcomes import Outcome, waiting_tasks
    from tactile_rt.models.grid.plan import read_grid
    from tactile_rt.sets.manifest import SweepManifest

    check_folder(folder)
    wanted = read_grid(plan)
    if waiting_tasks(wanted, folder):
        SweepManifest.read(Path(wanted.data))
    with needing("train"):
        from tactile_rt.models.grid.picture import draw_grid
        from tactile_rt.models.grid.pool import run_grid
        from tactile_rt.models.grid.results import GridResults, gather, write_results

    def conclude() -> GridResults:
        results = gather(wanted, folder)
        write_results(results, folder)
        draw_grid(results, folder / "task_performance.png")
        return results

    def show(found: Outcome, done: int, total: int) -> None:
        update(completed=done, total=total)
        right = found.right()
        said = found.failed or f"top-1 {100 * right.mean():.1f} %"
        took = f", {found.seconds:.0f} CPU s" if found.seconds else ""
        typer.echo(f"{done}/{total} {found.name}, seed {found.seed}: {said}{took}", err=True)
        if done % per_seed == 0:
            conclude()

    per_seed = -(-len(wanted.tasks()) // wanted.seeds)
    done = len(wanted.tasks()) - len(waiting_tasks(wanted, folder))
    with progress_bar("tasks", len(wanted.tasks()), done, counted=True) as update:
        run_grid(wanted, folder, processes, show, accelerator)
    told_as_json(conclude(), json)
    typer.echo(f"{folder}: its tables and pictures", err=True)
