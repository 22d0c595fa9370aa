"""What several tests of recipes share."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from tiny_runs import run_by_options


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the figures of studies and pages, and leave out what takes longest: their files and pictures are blank.

    For tests of what stands in tables and in words beside them.
    """
    from coim.experiments.figures import write
    from coim.experiments.report import page, summary_png

    blank = page.svg(Figure(figsize=(7, 3)))

    def touch(figure: Figure, path: Path, **how: object) -> None:
        path.touch()

    monkeypatch.setattr(Figure, "savefig", touch)
    monkeypatch.setattr(page, "svg", lambda figure: blank)
    for module in (write, summary_png):
        monkeypatch.setattr(module, "lay_out", lambda figure: figure)


@pytest.fixture(scope="session")
def cluster() -> Iterator:
    """A Ray of this machine: a head without cores, as on clusters whose head has other work, and one node with two.

    One for all tests: it takes as long to begin as what is computed on it.
    """
    ray_cluster = pytest.importorskip("ray.cluster_utils")
    from coim.experiments.study.cluster import ray_running

    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("RAY_worker_niceness", "0")  # or a machine with other work lets the tests wait
        nodes = ray_cluster.Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        nodes.add_node(num_cpus=2)
    with ray_running(io.StringIO(), address=nodes.address):
        yield nodes
    nodes.shutdown()


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished tiny runs: "one", "fleet" of three and "free", a fleet of two without imagination."""
    from coim.experiments.report.run_report import write_report

    folder = tmp_path_factory.mktemp("runs")
    options = {"one": [], "fleet": ["--num-runs", "3"], "free": ["--num-runs", "2", "--imagine", "none"]}
    for name, more in options.items():
        run_by_options(folder / name, "--quiet", *more, page=name == "one")
        write_report([folder / name])
    return folder
