"""Quotas of control groups: versions 1 and 2, both at once, nested, namespaced, and one of this machine."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from attentionvote.execution.processor_quota import processor_quota

V2 = "31 23 0:28 {root} {folder} rw,relatime - cgroup2 cgroup2 rw\n"
V1 = "32 31 0:29 {root} {folder} rw,relatime shared:9 - cgroup cgroup rw,{controllers}\n"
OTHER = "22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n"


class Machine:
    """A process and its mounted control groups, made of files."""

    def __init__(self, folder: Path) -> None:
        self.proc, self.system = folder / "proc", folder / "system"
        self.proc.mkdir()
        self.mounts, self.groups = OTHER, ""

    def version_2(self, folder: str = "/sys/fs/cgroup", root: str = "/", **quotas: str) -> None:
        """Mount version 2; ``quotas`` by path, ``__`` for a slash."""
        self.mounts += V2.format(root=root, folder=folder)
        for path, quota in quotas.items():
            self.write(folder, path, "cpu.max", f"{quota}\n")

    def version_1(self, folder: str, root: str = "/", controllers: str = "cpu,cpuacct", **quotas: str) -> None:
        """Mount the hierarchy of some controllers of version 1."""
        self.mounts += V1.format(root=root, folder=folder, controllers=controllers)
        for path, quota in quotas.items():
            for name, value in zip(("quota", "period"), quota.split(), strict=True):
                self.write(folder, path, f"cpu.cfs_{name}_us", f"{value}\n")

    def write(self, folder: str, path: str, name: str, text: str) -> None:
        place = self.system / folder.lstrip("/") / path.replace("__", "/").strip("/")
        place.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)

    def quota(self, *groups: str) -> float:
        """Of a process whose /proc/self/cgroup has these lines."""
        (self.proc / "mountinfo").write_text(self.mounts)
        (self.proc / "cgroup").write_text("".join(f"{group}\n" for group in groups))
        return processor_quota(self.proc, self.system)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_a_container_sees_its_quota_at_the_root(machine: Machine) -> None:
    machine.version_2(__="200000 100000")
    assert machine.quota("0::/") == 2.0


def test_the_smallest_quota_on_the_way_to_the_root_counts(machine: Machine) -> None:
    machine.version_2(
        a="400000 100000", a__b="max 100000", a__b__c="150000 50000", a__b__c__deeper="10000 100000", z="1000 100000"
    )
    assert machine.quota("0::/a/b/c") == 3.0
    assert machine.quota("0::/a/b") == 4.0
    assert machine.quota("0::/elsewhere") == math.inf


def test_systemd_run_with_a_quota(machine: Machine) -> None:
    machine.version_2(**{"system.slice": "max 100000", "system.slice__run-u1.service": "200000 100000"})
    assert machine.quota("0::/system.slice/run-u1.service") == 2.0


def test_slurm_of_version_1_limits_the_job_not_the_step(machine: Machine) -> None:
    machine.version_1("/sys/fs/cgroup/cpu,cpuacct", slurm__uid_1__job_7="800000 100000", slurm__uid_1="-1 100000")
    machine.version_1("/sys/fs/cgroup/memory", controllers="memory", slurm__uid_1__job_7="100000 100000")
    assert machine.quota("5:memory:/slurm/uid_1/job_7", "4:cpuacct,cpu:/slurm/uid_1/job_7/step_0") == 8.0


def test_a_container_of_version_1_names_a_group_that_it_sees_as_the_root(machine: Machine) -> None:
    machine.version_1("/sys/fs/cgroup/cpu", root="/docker/0a1b", controllers="cpu", __="50000 100000")
    assert machine.quota("1:cpu:/docker/0a1b") == 0.5


def test_a_group_inside_a_container(machine: Machine) -> None:
    machine.version_1("/cpu", root="/kubepods/pod1", controllers="cpu", __="400000 100000", inner="250000 100000")
    assert machine.quota("1:cpu:/kubepods/pod1/inner") == 2.5


@pytest.mark.parametrize(("root", "group"), [("/..", "/"), ("/", "/../other"), ("/docker/x", "/")])
def test_a_group_that_is_not_in_the_mount_has_at_least_the_mounts_quota(
    machine: Machine, root: str, group: str
) -> None:
    machine.version_2(root=root, __="300000 100000")
    assert machine.quota(f"0::{group}") == 3.0


def test_hybrid_machines_have_the_controller_in_version_1(machine: Machine) -> None:
    machine.version_2("/sys/fs/cgroup/unified")
    machine.version_1("/sys/fs/cgroup/cpu", controllers="cpu", job="100000 100000")
    assert machine.quota("1:cpu:/job", "0::/init.scope") == 1.0


def test_both_versions_limit_at_once(machine: Machine) -> None:
    machine.version_2("/two", a="300000 100000")
    machine.version_1("/one", controllers="cpu", b="200000 100000")
    assert machine.quota("1:cpu:/b", "0::/a") == 2.0
    assert machine.quota("1:cpu:/", "0::/a") == 3.0


def test_a_mount_point_with_a_blank(machine: Machine) -> None:
    machine.version_2("/my groups", a="200000 100000")
    machine.mounts = machine.mounts.replace("/my groups", r"/my\040groups")
    assert machine.quota("0::/a") == 2.0


@pytest.mark.parametrize("text", ["", "max", "max 100000", "0 100000", "100000 0", "many 100000"])
def test_what_is_no_quota_limits_nothing(machine: Machine, text: str) -> None:
    machine.version_2(__=text)
    assert machine.quota("0::/") == math.inf


def test_no_control_groups_at_all(tmp_path: Path) -> None:
    assert processor_quota(tmp_path / "proc", tmp_path) == math.inf


@pytest.fixture
def real_group() -> Iterator[Path]:
    """A nested control group of this machine, with a quota of one and a half cores above it."""
    outer = Path(f"/sys/fs/cgroup/cpu/attentionvote-{os.getpid()}")
    try:
        (outer / "inner").mkdir(parents=True)
        (outer / "cpu.cfs_period_us").write_text("100000")
        (outer / "cpu.cfs_quota_us").write_text("150000")
        quota = (outer / "cpu.cfs_quota_us").read_text()
    except OSError as error:
        pytest.skip(f"no control group can be made here ({error})")
    if quota.strip() != "150000":
        pytest.skip("control groups of this machine take no quota")
    yield outer / "inner"
    (outer / "inner").rmdir()
    outer.rmdir()


def test_a_real_group_of_this_machine(real_group: Path) -> None:
    """The process moves itself into the group, as Slurm and systemd do before they start it."""
    program = (
        "import os, sys; open(sys.argv[1], 'w').write(str(os.getpid()))\n"
        "from attentionvote.execution.hardware import cores\n"
        "from attentionvote.execution.processor_quota import processor_quota\n"
        "print(processor_quota(), cores())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(real_group / "cgroup.procs")], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["1.5", "1"]
