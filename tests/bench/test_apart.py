"""The product does without its rigs: no module of it names one, but the command that runs them."""

import ast
from pathlib import Path

import bench
import tactile_rt

PRODUCT = Path(tactile_rt.__file__).parent
RIGS = Path(bench.__file__).parent
FINDS_THEM = PRODUCT / "cli" / "bench.py"


def named(path: Path) -> list[str]:
    """Modules of ours that a file imports, or names in a string."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [f"{alias.name}." for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.append(f"{node.module}.")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return [name for name in found if name.startswith(("bench.", "tests."))]


def test_no_module_of_the_product_names_a_rig_or_a_test():
    files = [p for p in PRODUCT.rglob("*.py") if p != FINDS_THEM]
    assert len(files) > 100
    assert {str(p): named(p) for p in files if named(p)} == {}


def test_what_would_be_found_is_found(tmp_path):
    assert named(FINDS_THEM) == ["bench."]
    assert named(RIGS / "sim" / "area.py")
    for text in ("import bench", "from tests.helpers import x", "f('bench.inference.x')"):
        (tmp_path / "m.py").write_text(text)
        assert named(tmp_path / "m.py"), text


def test_no_public_class_of_the_rigs_has_a_name_of_the_product():
    def classes(folder):
        trees = [ast.parse(p.read_text(encoding="utf-8")) for p in folder.rglob("*.py")]
        nodes = [n for tree in trees for n in tree.body if isinstance(n, ast.ClassDef)]
        return [n.name for n in nodes if not n.name.startswith("_")]

    rigs = classes(RIGS)
    assert len(rigs) == len(set(rigs))
    assert set(rigs) & set(classes(PRODUCT)) == set()


def test_rigs_use_the_product_and_not_its_fakes():
    rigs = {p: p.read_text(encoding="utf-8") for p in RIGS.rglob("*.py")}
    assert len(rigs) > 30
    assert [p for p, text in rigs.items() if "tactile_rt.testing" in text] == []
