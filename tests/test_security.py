"""What SECURITY.md promises of the code as a whole."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [*ROOT.glob("vrrt_jax/**/*.py"), *ROOT.glob("nrp_jax/**/*.py")]
# Modules that unpickle, or talk to others; who may use one, as it needs no network.
NEVER = {"pickle", "dill", "joblib", "cloudpickle", "shelve", "marshal", "requests", "urllib3"}
RARELY = {
    # A free port of 127.0.0.1; whether a cluster that was named is there.
    "socket": {"vrrt_jax/scene/page.py", "vrrt_jax/core/cluster.py"},
    "urllib": {"vrrt_jax/robots/urdf.py"},  # unquotes the names of meshes
    "http": set(),
}


def calls_and_imports(file):
    """Dotted names that a module calls or imports."""
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_modules_neither_unpickle_nor_talk(file):
    place = file.relative_to(ROOT).as_posix()
    for name in calls_and_imports(file):
        first = name.partition(".")[0]
        assert first not in NEVER, name
        assert place in RARELY.get(first, {place}), name
        assert name not in ("np.load", "numpy.load", "yaml.unsafe_load", "eval", "exec"), name
        if name in ("Image.open", "PIL.Image.open"):
            assert place in ("vrrt_jax/core/pictures.py", "vrrt_jax/splat/photographs.py")
        if name in ("ElementTree.parse", "ET.parse"):
            assert place == "nrp_jax/scene/mobile_mjcf.py"  # a packaged robot


def test_pages_are_for_this_machine():
    from vrrt_jax.scene import page

    assert page.HOST == "127.0.0.1"


def test_every_promise_has_a_test():
    rows = [line for line in (ROOT / "SECURITY.md").read_text().splitlines() if "`tests/" in line]
    assert len(rows) >= 8
    for row in rows:
        for part in row.split("`"):
            assert not part.startswith("tests/") or (ROOT / part).is_file(), part
