"""The notebooks run from top to bottom."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    cache = str(Path.home() / ".cache" / "vrrt_jax_tests")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)
    notebook = nbformat.read(path, as_version=4)
    small = notebook.cells[1]
    assert "FRAMES = 24" in small.source
    small.source = small.source.replace("FRAMES = 24", "FRAMES = 3")
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=400, kernel_name="python3", resources=resources).execute()
    assert (tmp_path / "quickstart.png").stat().st_size > 20_000
