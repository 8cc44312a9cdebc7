"""Slurm through dask-jobqueue: jobs of workers come and go while a campaign runs.

pip install 'turgor[cluster]' dask-jobqueue
python slurm.py      # on a login node, or in a small job of its own
"""

from dask_jobqueue import SLURMCluster
from distributed import Client

import turgor


def make_cluster(**options):
    """Workers for `turgor.reproduce`: in each job 16 processes of one thread."""
    return SLURMCluster(
        cores=16,
        processes=16,  # a process a core
        memory="16GB",
        walltime="02:00:00",
        job_script_prologue=["export OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1"],
        **options,  # queue="...", account="...", interface="ib0": what your site asks for
    )


if __name__ == "__main__":
    with make_cluster() as cluster, Client(cluster) as client:
        cluster.scale(jobs=4)
        client.wait_for_workers(1)  # the others may come later
        print(turgor.reproduce("runs/paper", executor=client))
