"""Build sdist and wheel, install the wheel into an empty environment, run the console script.

The wheel is built from the sdist, so that a file missing from the sdist is noticed here; and the
sdist finds all its tests, and runs those of its pages. Neither rigs nor tests are in the wheel, and
whoever asks for a rig is told so. What a package index shows leads nowhere into a tree that is not
there, and the command that a message names installs what it says.
"""

import email
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Of a Markdown page: where its links and pictures lead.
TARGET = re.compile(r"(?<!`)\]\(([^)\s]+)\)|<(?:img|a)\s[^>]*(?:src|href)=\"([^\"]+)\"")
OF_THE_SDIST = ("tests/test_package.py", "tests/test_pages.py", "tests/test_words.py")


def main() -> None:
    os.environ.pop("PYTHONPATH", None)  # a checkout's package is not the installed one
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        build = [sys.executable, "-m", "build", "--outdir", str(out / "dist"), str(ROOT)]
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        (wheel,) = (out / "dist").glob("*.whl")
        with zipfile.ZipFile(wheel) as packed:
            folders = {name.partition("/")[0] for name in packed.namelist()}
            (metadata,) = (n for n in packed.namelist() if n.endswith(".dist-info/METADATA"))
            page = email.message_from_bytes(packed.read(metadata)).get_payload()
        assert sorted(folders - {"tactile_rt"}) == [f"{wheel.name.rsplit('-', 3)[0]}.dist-info"]
        leads = [a or b for a, b in TARGET.findall(str(page))]
        assert page and [t for t in leads if not t.startswith(("https://", "#"))] == [], leads
        check_sdist(out)
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
        # The extra that is asked for comes without an index that has this package.
        line = "from tactile_rt.core.packages import install_extra; print(install_extra('dbc'))"
        told = subprocess.run([python, "-c", line], cwd=out, capture_output=True, text=True)
        subprocess.run(shlex.split(told.stdout), check=True, cwd=out, stdout=subprocess.DEVNULL)
        subprocess.run([python, "-c", "import cantools"], check=True, cwd=out)
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


def check_sdist(out: Path) -> None:
    """Unpack it elsewhere, and let it find its tests."""
    (archive,) = (out / "dist").glob("*.tar.gz")
    shutil.unpack_archive(archive, out)
    tree = out / archive.name.removesuffix(".tar.gz")
    pytest = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    here = {**os.environ, "PYTHONPATH": str(tree)}  # before a checkout that is installed
    for more in (["--collect-only"], [*OF_THE_SDIST, "-k", "not built_offline and not does_what"]):
        done = subprocess.run([*pytest, *more], cwd=tree, env=here, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout[-2000:]
        sys.stdout.write(f"{archive.name}: {done.stdout.strip().splitlines()[-1].strip('= ')}\n")


if __name__ == "__main__":
    main()
