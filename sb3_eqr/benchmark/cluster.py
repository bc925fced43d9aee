"""Execute runs as tasks of Ray, on this machine or on a cluster. The only module that imports Ray."""

import logging
import math
import os
import socket
from typing import Any

import ray

from sb3_eqr.benchmark.dispatch import Crash
from sb3_eqr.benchmark.runs import Run, Settings
from sb3_eqr.benchmark.training import execute


class Cluster:
    """
    A Ray task per run, with the methods of :class:`~sb3_eqr.benchmark.dispatch.Processes`; Ray decides how many run at once.

    :param address: of a Ray cluster that can access the benchmark's folder, or "local" for this machine
    :param cpus: CPUs that Ray reserves for a run
    :param gpus: GPUs that Ray reserves for a run, such as 0.1 for ten runs per GPU
    :raises ConnectionError: if no cluster answers at the address
    :raises ValueError: if no machine of the cluster has the resources of a run, which would wait forever
    """

    slots = math.inf

    def __init__(self, settings: Settings, address: str, cpus: float, gpus: float):
        self._settings = settings
        connect(address)
        for name, flag, needed in (("CPU", "--cpus-per-run", cpus), ("GPU", "--gpus-per-run", gpus)):
            there = max((node["Resources"].get(name, 0) for node in ray.nodes() if node["Alive"]), default=0)
            if needed > there:
                ray.shutdown()
                raise ValueError(f"{flag} must be <= {there:g}, the {name}s of the largest machine, got {needed:g}.")
        self._task = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)(execute)

    def start(self, run: Run) -> Any:
        return self._task.remote(run, self._settings)

    def wait(self, handles: list[Any], timeout: float) -> list[Any]:
        return ray.wait(handles, timeout=timeout)[0]

    def outcome(self, handle: Any) -> str:
        try:
            return ray.get(handle)
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None) or error
            raise Crash(" ".join([type(cause).__name__, *str(cause).strip().splitlines()[-1:]])) from error

    def close(self) -> None:
        ray.shutdown()  # which ends the tasks


def connect(address: str) -> None:
    """Connect to the cluster at the address, or start one on this machine."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:  # else "auto", or another of Ray's forms
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except OSError as error:  # Ray would wait for minutes and then exit the process
            raise ConnectionError(
                f"--ray: no Ray cluster answers at {address} ({error}). Start one with ray start --head."
            ) from error
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # as Ray's own warning recommends
    local: dict[str, Any] = {"include_dashboard": False} if address == "local" else {}
    try:
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **local)
    except ConnectionError as error:
        raise ConnectionError(f"{error}. If it asks for a token, set RAY_AUTH_MODE=token (docs/benchmark.md).") from error
