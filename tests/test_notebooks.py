"""The notebooks run from top to bottom."""

import runpy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
SMALL = {  # what makes each quick
    "01_quickstart": {"FRAMES = 24": "FRAMES = 3"},
    "02_homes": {"QUERIES = 6": "QUERIES = 1", '"rrt": None, "rrt-is": None, ': ""},
}
PICTURES = {"01_quickstart": "quickstart.png", "02_homes": "plan.png"}  # that each leaves


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    cache = str(Path.home() / ".cache" / "vrrt_jax_tests")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)
    notebook = nbformat.read(path, as_version=4)
    for large, small in SMALL[path.stem].items():
        assert large in notebook.cells[1].source
        notebook.cells[1].source = notebook.cells[1].source.replace(large, small)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=400, kernel_name="python3", resources=resources).execute()
    assert (tmp_path / PICTURES[path.stem]).stat().st_size > 20_000


def test_a_planner_of_ones_own_plans(capsys):
    """The example for those who write planners runs as a script, and solves its problem."""
    script = Path(__file__).parents[1] / "notebooks" / "write_a_planner.py"
    scope = runpy.run_path(str(script), run_name="__main__")
    assert scope["result"].ok
    assert capsys.readouterr().out.startswith("SOLVED")
