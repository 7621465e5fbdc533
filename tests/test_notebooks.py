"""The notebooks run from top to bottom."""

import runpy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
SMALL = {  # what makes each quick
    "01_quickstart": {"FRAMES = 24": "FRAMES = 3", 'ENGINE = "mjx"': 'ENGINE = "closed_form"'},
    "02_homes": {"QUERIES = 6": "QUERIES = 1", '"rrt": None, "rrt-is": None, ': ""},
    "03_your_own_robot": {"TRAIN = True": "TRAIN = False"},
    "04_benchmarks": {
        "TASKS = 3": "TASKS = 0",
        "HOMES = (1_000_001, 1_000_002)": "HOMES = (1_000_001,)",
        "QUERIES = 5": "QUERIES = 1",
        '"rrt", "rrt-connect", "nrp-d", "nrp-g")': '"rrt-connect",)',
    },
}
# Those that plan with images, or ask networks, compute too much for programs that compile quickly.
LIGHT = ("03_your_own_robot", "04_benchmarks")


def outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def pictures(notebook):
    data = [output.get("data", {}) for output in outputs(notebook)]
    return [each["image/png"] for each in data if "image/png" in each]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, tmp_path, monkeypatch):
    cache = str(Path.home() / ".cache" / "vrrt_jax_tests")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)
    notebook = nbformat.read(path, as_version=4)
    for large, small in SMALL[path.stem].items():
        assert large in notebook.cells[1].source
        notebook.cells[1].source = notebook.cells[1].source.replace(large, small)
    if path.stem in LIGHT:
        monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=400, kernel_name="python3", resources=resources).execute()
    assert max(map(len, pictures(notebook))) > 8_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_shows_what_it_does(path):
    """Outputs are kept, so that a notebook can be read where it is not run."""
    notebook = nbformat.read(path, as_version=4)
    assert pictures(notebook)
    assert all(output.output_type != "error" for output in outputs(notebook))


def test_a_planner_of_ones_own_plans(capsys):
    """The example for those who write planners runs as a script, and solves its problem."""
    script = Path(__file__).parents[1] / "notebooks" / "write_a_planner.py"
    scope = runpy.run_path(str(script), run_name="__main__")
    assert scope["result"].ok
    assert capsys.readouterr().out.startswith("SOLVED")
