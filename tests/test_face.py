"""What `from tactile_rt import ...` gives, and what it costs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import tactile_rt
from tests.helpers.processes import run_program

README = Path(tactile_rt.__file__).parents[1] / "README.md"
IMPORT_CPU_S = 0.2


def test_every_name_is_there_and_listed_once_in_order() -> None:
    assert tactile_rt.__all__ == sorted(set(tactile_rt.__all__))
    for name in tactile_rt.__all__:
        assert getattr(tactile_rt, name) is not None
    assert set(tactile_rt.__all__) <= set(dir(tactile_rt))


def test_names_are_loaded_when_they_are_used() -> None:
    code = (
        "import sys, time; began = time.process_time(); import tactile_rt\n"
        "spent = time.process_time() - began\n"
        "assert 'numpy' not in sys.modules and 'onnxruntime' not in sys.modules\n"
        "from tactile_rt import Chunk, open_source\n"
        "assert 'onnxruntime' not in sys.modules\n"
        "from tactile_rt import Classifier\n"
        "assert 'onnxruntime' in sys.modules and 'torch' not in sys.modules\n"
        "print(spent)"
    )
    spent = [float(run_program(program=code, check=True).stdout) for _ in range(3)]
    assert min(spent) <= IMPORT_CPU_S


def test_nothing_is_told_to_the_maker_of_the_runtime(tmp_path: Path) -> None:
    """Its reports begin with an identity and a store of what is to be sent, in the user's cache."""
    code = "import tactile_rt; tactile_rt.load_model(tactile_rt.shipped_model())"
    left_out = ("CI", "ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")
    environment = {k: v for k, v in os.environ.items() if k not in left_out}
    environment |= {"HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert list(tmp_path.iterdir()) == []


def test_the_readme_s_program_needs_one_import() -> None:
    (program, *_) = re.findall(r"```python\n(.*?)```", README.read_text("utf-8"), re.S)
    assert len(re.findall(r"^(?:from|import) ", program, re.M)) == 1
    names = re.findall(r"^from tactile_rt import (.*)$", program, re.M)[0].split(", ")
    assert set(names) <= set(tactile_rt.__all__)
    compile(program, "README.md", "exec")
