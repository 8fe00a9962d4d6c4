"""The same jobs on a real Ray cluster of two nodes on this machine."""

import json
import subprocess
import sys
from importlib.util import find_spec

import pytest

if find_spec("ray") is None:
    pytest.skip("Ray is an extra, which is not installed", allow_module_level=True)

_CLUSTER = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
cluster.add_node(num_cpus=1)
print(cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


@pytest.fixture(scope="module")
def address(benchmark_environment):
    """A cluster of two nodes of one core each, whose workers find the toy tasks."""
    variables = {**benchmark_environment, "RAY_DISABLE_IMPORT_WARNING": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    process = subprocess.Popen(
        [sys.executable, "-c", _CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=variables
    )
    yield process.stdout.readline().strip()
    process.communicate("", timeout=60)


def test_two_nodes_work_the_grid_off(address, tmp_path, start_benchmark):
    assert address, "no cluster came up"
    out = tmp_path / "ray"
    grid = ("--envs", "toy/near,toy/far", "--methods", "simple_dp3", "--seeds", "0", "--ray", address)
    process = start_benchmark(out, *grid)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    found = json.loads((out / "results.json").read_text())
    assert [c["n"] for c in found["cells"]] == [4] * 2
    assert not found["missing"]
    places = {json.loads(path.read_text())["place"] for path in out.rglob("*.json") if path.name == "train.json"}
    assert len(places) == 2, "both nodes had a part in it"


def test_no_cluster_at_an_address_is_one_line(tmp_path, benchmark_here):
    words = ("--envs", "toy/near", "--seeds", "0", "--ray", "127.0.0.1:1")
    code, output = benchmark_here(tmp_path / "none", *words)
    assert code == 2, output
    assert "no Ray cluster answers at '127.0.0.1:1'" in " ".join(output.split())
