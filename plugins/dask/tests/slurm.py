"""A Slurm of two nodes on this machine, by Debian's slurm-wlm and munge: `with started(folder) as
environment`."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch", "scancel", "squeue", "sinfo")
NODES = ("node1", "node2")
_PATIENCE_S = 30
_CONFIG = """
ClusterName=bench
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
ReturnToService=2
JobRequeue=0
KillWait=5
PartitionName=all Nodes={nodes} Default=YES MaxTime=01:00:00 State=UP
"""


def lacking() -> str:
    """Why there can be no Slurm here; empty where there can."""
    absent = [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]
    if absent:
        return f"{absent[0]} is not installed"
    return "" if os.geteuid() == 0 else "only root can start Slurm's daemons"


@contextlib.contextmanager
def started(folder: Path) -> Iterator[dict[str, str]]:
    """The environment in which commands find this Slurm."""
    host, port = socket.gethostname().split(".")[0], _free_port()
    # Munge wants a folder that nobody else can write to, and does not look at those above.
    (folder / "munge").mkdir(parents=True)
    (folder / "state").mkdir()
    key = folder / "munge" / "key"
    key.write_bytes(os.urandom(1024))
    key.chmod(0o600)
    config = folder / "slurm.conf"
    nodes = "".join(
        f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={_free_port()} CPUs=1"
        " RealMemory=4000\n"
        for name in NODES
    )
    config.write_text(
        nodes + _CONFIG.format(host=host, port=port, folder=folder, nodes=",".join(NODES))
    )
    environment = os.environ | {"SLURM_CONF": str(config), "PATH": _path()}
    daemons = [
        [
            "munged",
            "--force",
            *(f"--{name}={folder}/munge/{name}" for name in ("socket", "seed-file", "log-file")),
        ],
        ["slurmctld", "-f", str(config)],
        *(["slurmd", "-N", name, "-f", str(config)] for name in NODES),
    ]
    daemons[0] += [f"--key-file={key}", f"--pid-file={folder}/munge/pid"]
    try:
        for command in daemons:
            subprocess.run(command, env=environment, check=True, capture_output=True)
        _wait_for_nodes(environment)
        yield environment
    finally:
        for path in (
            *folder.glob("slurmd.*.pid"),
            folder / "slurmctld.pid",
            folder / "munge" / "pid",
        ):
            with contextlib.suppress(OSError, ValueError):
                os.kill(int(path.read_text()), signal.SIGTERM)


def jobs(environment: dict[str, str]) -> dict[str, str]:
    """The node of every job that runs, by the job's number."""
    command = ["squeue", "--noheader", "--states=RUNNING", "--array", "--format=%i %N"]
    lines = subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    return dict(line.split() for line in lines if len(line.split()) == 2)


def _wait_for_nodes(environment: dict[str, str]) -> None:
    command = ["sinfo", "--noheader", "--Node", "--format=%N %T"]
    said = ""
    for _ in range(_PATIENCE_S):
        said = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False
        ).stdout
        if said.count(" idle") == len(NODES):
            return
        time.sleep(1)
    raise RuntimeError(f"Slurm's nodes are not idle after {_PATIENCE_S} s: {said}")


def _path() -> str:
    return os.environ.get("PATH", "") + os.pathsep + "/usr/sbin"


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
