"""Who may import whom."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]


def imported(path):
    """Modules that a file imports, at any depth of its code."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_nrp_imports_only_the_core():
    for path in (ROOT / "nrp_jax").rglob("*.py"):
        for module in imported(path):
            if module == "vrrt_jax" or module.startswith("vrrt_jax."):
                assert module.startswith("vrrt_jax.core"), f"{path} imports {module}"


def test_vrrt_never_imports_nrp():
    for path in (ROOT / "vrrt_jax").rglob("*.py"):
        assert not any(m.split(".")[0] == "nrp_jax" for m in imported(path)), path


def test_the_core_knows_neither_splats_nor_networks():
    for path in (ROOT / "vrrt_jax" / "core").rglob("*.py"):
        for module in imported(path):
            assert not module.startswith(("vrrt_jax.splat", "flax", "optax")), (path, module)
