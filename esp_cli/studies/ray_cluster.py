"""The connection to a Ray cluster: refused where nothing answers, or where a node has other versions."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping, Sequence
from typing import Any

import ray
from ray.exceptions import RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from esp_cli.studies.versions import refuse_difference, versions
from esp_envs.errors import UserError
from esp_envs.installed import available_cores

NAMESPACE = "esp"
CONNECT_S = 10.0
"""Seconds in which a cluster has to answer."""
_OBJECT_STORE_BYTES = 256 * 2**20


class ClusterError(UserError):
    """The cluster cannot be used; the text is one sentence for the user."""


def connect(address: str | None) -> None:
    """Connect to a cluster, or start one of this machine alone.

    Args:
        address: of the cluster; by default that of RAY_ADDRESS.

    Raises:
        ClusterError: none answers, it is of another version of Ray or Python, or a node cannot run esp.
        UserError: a node has other versions of esp or its libraries than this machine.
    """
    ray._private.worker._worker_logs_enabled = False  # Ray prints the loss of a node to standard output
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    quiet: dict[str, Any] = {"namespace": NAMESPACE, "log_to_driver": False, "logging_level": "ERROR"}
    if address is None and not os.environ.get("RAY_ADDRESS"):
        quiet |= {"address": "local", "num_cpus": available_cores(), "include_dashboard": False}
        quiet |= {"object_store_memory": _OBJECT_STORE_BYTES}
    else:
        quiet["address"] = address
    try:
        _knock(address or os.environ.get("RAY_ADDRESS", ""))
        ray.init(**quiet)
    except (OSError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise ClusterError(
            f"cannot use the Ray cluster at {address or 'RAY_ADDRESS'} ({reason}); check --address, "
            "RAY_AUTH_MODE, and that the nodes have the same versions of Ray and Python"
        ) from None
    try:
        _refuse_other_versions()
    except BaseException:
        ray.shutdown()
        raise


def offers() -> list[Mapping[str, float]]:
    """Return what each node that is there has, by Ray's name of the resource."""
    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def refuse_what_no_node_has(needed: Mapping[str, float], name: str, nodes: Sequence[Mapping[str, float]]) -> None:
    """Refuse a run that would wait for ever, since no node offers what it needs.

    Args:
        needed: resources by Ray's name: "CPU", "GPU", and "memory" in bytes.
        name: of the run.
        nodes: what each node offers.

    Raises:
        ClusterError: there is no such node.
    """
    if any(all(node.get(kind, 0.0) >= amount for kind, amount in needed.items()) for node in nodes):
        return
    memory = f"{needed['memory'] / 1e9:.1f} GB of memory"
    asked = ", ".join(["a core", *(["a GPU"] if needed["GPU"] else []), memory])
    # a run of fewer seeds needs less memory, and nothing else
    fewer = any(all(node.get(kind, 0.0) >= needed[kind] for kind in ("CPU", "GPU")) for node in nodes)
    advice = "add one, or use fewer seeds" if fewer else "add one"
    raise ClusterError(f"no node of the cluster offers what {name} needs ({asked}); {advice}")


def _knock(address: str) -> None:
    """Refuse an address where nothing answers; Ray would wait for minutes.

    Raises:
        OSError: nothing answers.
        UserError: it is that of a server for Ray's client.
    """
    if address.startswith("ray://"):
        raise UserError("the driver has to be a machine of the cluster; Ray's client is not supported")
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()


def _refuse_other_versions() -> None:
    """Refuse a cluster of which a node that is there now has other versions, or no esp.

    Raises:
        UserError: there is such a node.
    """
    nodes = [node for node in ray.nodes() if node["Alive"]]
    ask = ray.remote(_node_versions)
    answers = [
        ask.options(num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], False)).remote()
        for node in nodes
    ]
    for node, answer in zip(nodes, answers, strict=True):
        name = node["NodeManagerHostname"]
        try:
            theirs = ray.get(answer, timeout=60)
        except RayError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ClusterError(f"the node {name} cannot run esp ({reason}); install esp-marl[cluster] there") from None
        refuse_difference(name, theirs)


def _node_versions() -> Mapping[str, str]:
    return dict(versions())
