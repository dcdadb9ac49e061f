"""launch/slurm.sh: what each command starts on which node; Slurm, Ray and torchrun are stand-ins."""

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "launch" / "slurm.sh"


@pytest.mark.parametrize(
    ("nodes", "words", "said"),
    [
        (
            2,
            "train RECIPE --data d",
            [
                "srun torchrun --nnodes 2 --nproc-per-node 8 --rdzv-backend c10d --rdzv-id 41 --rdzv-endpoint n1:20041 "
                "-m gcd_train train RECIPE --data d"
            ],
        ),
        (
            1,
            "generate drop out",
            ["ray start --head --port 20041", "gcd-train generate drop out --ray n1:20041"],
        ),
        (
            3,
            "evaluate --data d",
            [
                "ray start --head --port 20041",
                "srun --nodes 2 --ntasks 2 --exclude n1 ray start --address n1:20041",
                "gcd-train evaluate --data d --ray n1:20041",
            ],
        ),
    ],
)
def test_training_goes_to_torchrun_and_all_else_to_ray(tmp_path: Path, nodes: int, words: str, said: list[str]) -> None:
    for name in ("srun", "ray", "gcd-train"):
        (tmp_path / name).write_text(f'#!/bin/sh\necho "{name} $*" >> "$LOG"\n')
    with (tmp_path / "gcd-train").open("r+") as script:  # what was started beside it may be slower
        script.write('#!/bin/sh\nuntil [ "$(grep -vc "^ray status" "$LOG")" -ge "$BEFORE" ]; do sleep 0.05; done\n')
        script.write('echo "gcd-train $*" >> "$LOG"\n')
    (tmp_path / "scontrol").write_text("#!/bin/sh\nprintf 'n1\\nn2\\nn3\\n'\n")
    for path in tmp_path.iterdir():
        path.chmod(0o755)
    slurm = {
        "SLURM_NNODES": str(nodes),
        "SLURM_GPUS_ON_NODE": "8",
        "SLURM_JOB_ID": "41",
        "SLURM_SUBMIT_DIR": str(tmp_path),
    }
    told = {
        **os.environ,
        **slurm,
        "LOG": str(tmp_path / "log"),
        "BEFORE": str(len(said) - 1),
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
    }
    subprocess.run(["bash", str(SCRIPT), *words.split()], env=told, check=True)
    lines = [line for line in (tmp_path / "log").read_text().splitlines() if not line.startswith("ray status")]
    assert len(lines) == len(said)
    assert all(any(line.startswith(each) for line in lines) for each in said), lines
