"""Free memory as containers and batch jobs grant it: control groups' files written by hand."""

from cuelearner_jax.storage.room import group_bytes


def test_a_batch_job_has_the_memory_that_its_narrowest_group_grants(tmp_path):
    groups = tmp_path / "cgroup"
    groups.write_text("1:name=systemd:/\n0::/slurm/job_7/step\n")
    assert group_bytes(groups, tmp_path) is None  # no group sets a limit

    def limit(group, allowed, used, files):
        (tmp_path / group).mkdir(parents=True, exist_ok=True)
        (tmp_path / group / "memory.max").write_text(f"{allowed}\n")
        (tmp_path / group / "memory.current").write_text(f"{used}\n")
        (tmp_path / group / "memory.stat").write_text(f"anon {used - files}\ninactive_file {files}\n")

    limit("slurm/job_7/step", "max", 50, 0)
    limit("slurm/job_7", 100, 80, 30)
    limit("slurm", 1000, 990, 0)
    assert group_bytes(groups, tmp_path) == 10
    limit("slurm", 1000, 500, 0)
    assert group_bytes(groups, tmp_path) == 50
    assert group_bytes(tmp_path / "none", tmp_path) is None
