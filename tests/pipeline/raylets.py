"""A real Ray cluster on this machine: a head and raylets, without dashboard and agents, each of which is a Python
process that takes seconds to start and that no task needs."""

import inspect
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

AGENTS = ("dashboard", "dashboard_agent", "runtime_env_agent")
PORT_FILES = (
    "metrics_agent_port",
    "metrics_export_port",
    "dashboard_agent_listen_port",
    "runtime_env_agent_port",
)
"""Files in which a raylet looks for where its agents listen."""
NODE = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_log_monitor": False}


def patiently[T](start: Callable[[], T]) -> T:
    """Return what starts.

    Try again where Ray gives a raylet up, which it does after half a minute, on a busy machine
    too.
    """
    for _ in range(2):
        with suppress(Exception):
            return start()
    return start()


@contextmanager
def running_cluster(num_raylets: int) -> Generator[Any]:
    """Start a cluster whose raylets have room for one task each; give Ray's `Cluster`."""
    quiet = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_enable_metrics_collection": "0"}
    patient = {"RAY_worker_register_timeout_seconds": "300", "RAY_memory_monitor_refresh_ms": "0"}
    os.environ |= quiet | patient  # other programs may have the memory
    from ray._private import ray_constants, services
    from ray.cluster_utils import Cluster

    build, start = (
        services._build_python_executable_command_memory_profileable,
        services.start_raylet,
    )

    def command(component: str, *args: Any, **kwargs: Any) -> list[str]:
        if component in AGENTS:
            return ["sh", "-c", "exec sleep 3600", "--"]
        return build(component, *args, **kwargs)

    def started(*args: Any, **kwargs: Any) -> Any:
        given = inspect.signature(start).bind(*args, **kwargs).arguments
        for name in PORT_FILES:
            (Path(given["session_dir"]) / f"{name}_{given['node_id']}").write_text("1")
        return start(*args, **kwargs)

    with (
        patch.dict(os.environ, {"PYTHONPATH": ""}),  # a node knows nothing of our tree
        patch.object(services, "_build_python_executable_command_memory_profileable", command),
        patch.object(services, "start_raylet", started),
        patch.object(ray_constants, "RAY_DASHBOARD_STARTUP_TIMEOUT_S", 0),
        patch.object(services, "logger"),  # which misses the dashboard
    ):
        head = NODE | {"include_dashboard": False, "no_monitor": True}
        cluster = patiently(lambda: Cluster(initialize_head=True, head_node_args=head))
        try:
            for _ in range(num_raylets - 1):
                patiently(lambda: cluster.add_node(**NODE))
            yield cluster
        finally:
            cluster.shutdown()
