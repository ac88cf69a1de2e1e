"""Build sdist and wheel, install the wheel into an empty environment, run the console script.

The wheel is built from the sdist, so that a file missing from the sdist is noticed here. Neither
rigs nor tests are in the wheel, and whoever asks for a rig is told so.
"""

import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        build = [sys.executable, "-m", "build", "--outdir", str(out / "dist"), str(ROOT)]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        (wheel,) = (out / "dist").glob("*.whl")
        with zipfile.ZipFile(wheel) as packed:
            folders = {name.partition("/")[0] for name in packed.namelist()}
        assert sorted(folders - {"tactile_rt"}) == [f"{wheel.name.rsplit('-', 3)[0]}.dist-info"]
        environment = out / "env"
        venv.create(environment, with_pip=True)
        pip = [str(environment / "bin" / "pip"), "install", "--quiet", str(wheel)]
        subprocess.run(pip, check=True)
        script = str(environment / "bin" / "tactile-rt")
        for arguments in (["--help"], ["--version"]):
            subprocess.run([script, *arguments], check=True, cwd=out, stdout=subprocess.DEVNULL)
        # A robot's install: the model loads, and a missing extra is named.
        code = (
            "from tactile_rt.classifier.model_file import load_model, shipped_model;"
            "print(load_model(shipped_model())[1].labels)"
        )
        python = str(environment / "bin" / "python")
        subprocess.run([python, "-c", code], check=True, cwd=out, stdout=subprocess.DEVNULL)
        for arguments, said in (
            (["run", "--source", "sim:mouse"], "tactile-rt[sim]"),
            (["bench", "align"], "measures from a checkout"),
        ):
            refused = subprocess.run(
                [script, *arguments], cwd=out, capture_output=True, text=True, check=False
            )
            assert refused.returncode == 2, refused
            assert said in refused.stderr and refused.stderr.count("\n") == 1, refused.stderr
        sys.stdout.write(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, installs and runs\n")


if __name__ == "__main__":
    main()
