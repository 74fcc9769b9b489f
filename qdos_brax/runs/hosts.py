"""Several processes, on one host or many, that share the members of a run.

jax finds the processes (flags, or what Slurm, Open MPI and Kubernetes set) and gives each its own accelerators. From
then on they communicate only through the run's folder: members do not exchange anything, so that a process that dies
takes no other with it.
"""

from __future__ import annotations

import dataclasses

import jax

from qdos_brax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Hosts:
    """Hold the number of this process, ``index`` from 0, and the ``count`` of all that share the run."""

    index: int = 0
    count: int = 1


ALONE = Hosts()


def join(coordinator: str | None, processes: int | None, process_id: int | None) -> Hosts:
    """Connect to the other processes; must come before anything else asks jax for its devices.

    Args:
        coordinator: "host:port" of the first process; None where the cluster's variables give it.
        processes: number of processes; None likewise.
        process_id: number of this one, from 0; None likewise.

    Raises:
        UserError: the processes did not connect.
    """
    from jax._src import distributed  # jax has no public way to ask for the number before it starts its devices

    try:
        jax.distributed.initialize(coordinator, processes, process_id)
        hosts = Hosts(distributed.global_state.process_id, distributed.global_state.num_processes or 1)
        jax.distributed.shutdown()  # waits for all
    except (ValueError, TypeError, RuntimeError) as error:
        raise UserError(
            f"--distributed: the processes did not connect ({str(error).splitlines()[0]}); outside Slurm, Open MPI and "
            "Kubernetes give --coordinator HOST:PORT, --processes N and --process-id I"
        ) from error
    # Otherwise jax would still number devices as one of many, and Orbax refuses what only one process has.
    distributed.global_state.process_id, distributed.global_state.num_processes = 0, 1
    return hosts
