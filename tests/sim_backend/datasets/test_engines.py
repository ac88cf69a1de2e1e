import os
import re
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import install_extra
from tactile_rt.sim_backend.datasets.engines import DIED, run_processes, run_ray
from tests.helpers.frail_work import FrailWork
from tests.helpers.source_tree import ROOT
from tests.helpers.waiting import until


def tries(folder: Path, name: str) -> list[int]:
    """The process of every try; none yet where the file is not there, or still empty."""
    file = folder / name
    return [int(pid) for pid in file.read_text().split()] if file.exists() else []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_every_name_is_done_once_and_processes_are_used_again(tmp_path: Path) -> None:
    names = [f"a-{i}" for i in range(7)]
    assert sorted(run_processes(FrailWork(tmp_path), names, 2)) == [(n, None) for n in names]
    workers = [tries(tmp_path, n) for n in names]
    assert all(len(w) == 1 for w in workers)
    assert len({w[0] for w in workers}) <= 2
    assert not any(alive(w[0]) for w in workers)


class Heard(FrailWork):
    """Notes which signals are held back when it arrives in another process."""

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        (self.folder / "held").write_text(
            " ".join(s.name for s in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
        )


def test_no_process_hears_an_interrupt_even_while_it_begins(tmp_path: Path) -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert sorted(run_processes(Heard(tmp_path), ["a", "b"], 2)) == [("a", None), ("b", None)]
    assert (tmp_path / "held").read_text() == "SIGINT"
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_one_process_works_in_order(tmp_path: Path) -> None:
    names = ["c", "a", "skips-broken", "b"]
    outcomes = list(run_processes(FrailWork(tmp_path), names, 1))
    assert outcomes == [("c", None), ("a", None), ("skips-broken", "broken"), ("b", None)]


def test_what_a_dead_process_was_at_is_tried_again(tmp_path: Path) -> None:
    names = ["dies-1", "a", "dies-9", "b"]
    outcomes = dict(run_processes(FrailWork(tmp_path), names, 2))
    assert outcomes == {"dies-1": None, "a": None, "b": None, "dies-9": DIED}
    assert [len(tries(tmp_path, n)) for n in names] == [2, 1, 3, 1]


def test_a_users_mistake_is_raised_as_it_was_and_stops_everyone(tmp_path: Path) -> None:
    run = run_processes(FrailWork(tmp_path), ["sleeps-60", "a", "refuses-x", "b"], 2)
    assert next(run) == ("a", None)
    until(lambda: tries(tmp_path, "sleeps-60"))
    with pytest.raises(ConfigError, match="refuses-x cannot be"):
        list(run)
    assert not (tmp_path / "b").exists()
    assert not any(alive(p) for n in ("sleeps-60", "refuses-x") for p in tries(tmp_path, n))


def test_closing_the_iterator_kills_the_processes(tmp_path: Path) -> None:
    run = run_processes(FrailWork(tmp_path), ["a", "sleeps-60"], 2)
    assert next(run) == ("a", None)
    until(lambda: tries(tmp_path, "sleeps-60"))
    run.close()
    assert not alive(tries(tmp_path, "sleeps-60")[0])


def test_no_process_outlives_a_parent_that_was_killed(tmp_path: Path) -> None:
    program = textwrap.dedent(f"""
        import sys
        from pathlib import Path
        if __name__ == "__main__":
            sys.path.insert(0, {str(ROOT)!r})
            from tests.helpers.frail_work import FrailWork
            from tactile_rt.sim_backend.datasets.engines import run_processes
            list(run_processes(FrailWork(Path({str(tmp_path)!r})), ["sleeps-60"], 1))
        """)
    (tmp_path / "main.py").write_text(program)
    parent = subprocess.Popen([sys.executable, tmp_path / "main.py"])
    until(lambda: tries(tmp_path, "sleeps-60"))
    (worker,) = tries(tmp_path, "sleeps-60")
    assert alive(worker)
    parent.kill()
    parent.wait()
    until(lambda: not alive(worker))


def test_processes_use_one_thread_each_and_leave_our_environment_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    (outcome,) = run_processes(os.getenv, ["OMP_NUM_THREADS"], 1)
    assert outcome == ("OMP_NUM_THREADS", "1")
    assert os.environ["OMP_NUM_THREADS"] == "8"


def test_without_ray_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=f"needs ray, .*: {re.escape(install_extra('cluster'))}"):
        list(run_ray(len, ["a"]))


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch):
    """Ray's own cluster of this machine, with two workers that find this folder's helpers."""
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_cluster_does_the_same(cluster: None, tmp_path: Path) -> None:
    names = ["a", "dies-1", "b", "dies-9", "skips-broken"]
    outcomes = dict(run_ray(FrailWork(tmp_path), names, processes=2, address="local"))
    assert outcomes == {
        "a": None, "b": None, "dies-1": None, "dies-9": DIED, "skips-broken": "broken"
    }  # fmt: skip
    assert [len(tries(tmp_path, n)) for n in names] == [1, 2, 1, 3, 1]
    with pytest.raises(ConfigError, match="refuses-x cannot be"):
        list(run_ray(FrailWork(tmp_path), ["refuses-x"], processes=2, address="local"))


@pytest.mark.filterwarnings("ignore")
def test_no_cluster_at_an_address_is_one_line(cluster: None, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no Ray cluster at 127\.0\.0\.1:1"):
        list(run_ray(FrailWork(tmp_path), ["a"], address="127.0.0.1:1"))
