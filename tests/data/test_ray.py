"""Datasets on a Ray cluster: the same bits, and nothing lost when a node dies."""

from __future__ import annotations

import time

import pytest
from fracture_samples import SMALL, bar_bell, same

from fracsim.data.samples import sample_block
from fracsim.data.workers import run_blocks
from fracsim.simulators.registry import make_simulator
from fracsim.solids.surface import read_surface

ray = pytest.importorskip("ray")


def test_a_cluster_of_three_nodes_loses_nothing_when_one_is_killed():
    from ray.cluster_utils import Cluster

    def slow_block(simulator, seed, block):  # defined in here, so that ray sends it by value
        """A block that takes as long as an expensive simulator would, and says on which node it was made."""
        time.sleep(0.3)
        return sample_block(simulator, seed, block), ray.get_runtime_context().get_node_id()

    simulator = make_simulator(read_surface(bar_bell()), SMALL, 0)
    blocks = list(range(12))
    expected = list(run_blocks(sample_block, simulator, 5, blocks))
    often = {"health_check_period_ms": 300}  # a dead node is noticed after five of them
    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": often}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        doomed = [cluster.add_node(num_cpus=1) for _ in range(2)][-1]
        ray.init(address=cluster.address, log_to_driver=False, configure_logging=False)
        cluster.wait_for_nodes()
        made, nodes = [], []
        for result, node in run_blocks(slow_block, simulator, 5, blocks, 2, "ray"):
            made.append(result)
            nodes.append(node)
            if len(made) == 5:
                cluster.remove_node(doomed, allow_graceful=False)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert len(set(nodes)) == 2  # both worked, and one of them died
    assert len(set(nodes[-4:])) == 1
    assert len(made) == len(blocks)
    for one, other in zip(made, expected, strict=True):
        same(one, other)
