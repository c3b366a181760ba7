"""Several processes for one run, on this machine:

    python3 benches/ranks.py OUT_FOLDER [KILLS]

Reconstructs 50 noisy views of a head of 128 cubed voxels by one, two and four processes of Open MPI, which share as many threads as
there are cores. Prints seconds in the method, the largest resident memory of a process, what the leading process sent, and how the
volumes differ from that of one process. With KILLS, a run of changing numbers of processes is killed as often, one process at
random moments by SIGKILL, and resumed. Needs Open MPI, libclang and numpy.
"""

import gzip
import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
BINARY = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/conefield"
SPECS = ["fdk", "os-sart", "cgls", "fista-tv", "smooth-tv"]
ENVIRONMENT = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1")


def command(count, threads, arguments):
    launch = ["mpirun", "-n", str(count), "--bind-to", "none", "--oversubscribe"]
    return launch + [str(BINARY), "--threads", str(threads), "reconstruct", *map(str, arguments)]


def processes():
    """The processes of the program that run now."""
    found = subprocess.run(["pgrep", "-f", f"^{BINARY}"], capture_output=True, text=True).stdout
    return [int(pid) for pid in found.split()]


def peaks(start):
    """Runs `start` and returns its output with the peak of each process in MiB."""
    run = subprocess.Popen(start, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    said = []
    reader = threading.Thread(target=lambda: said.append(run.stdout.read()))
    reader.start()
    peak = {}
    while run.poll() is None:
        for pid in processes():
            try:
                lines = Path(f"/proc/{pid}/status").read_text()
            except OSError:
                continue
            found = re.search(r"VmHWM:\s+(\d+)", lines)
            if found:
                peak[pid] = int(found[1]) / 1024
        time.sleep(0.05)
    reader.join()
    assert run.returncode == 0, said[0]
    return said[0], list(peak.values())


def volume(run):
    content = gzip.open(run / "volume.nii.gz").read()
    start = int(np.frombuffer(content[108:112], "<f4")[0])
    return np.frombuffer(content[start:], "<f4")


def differences(found, want):
    off = np.abs(found - want) / np.abs(want).max()
    return f"{off.max():.1e}, rms {np.sqrt((off**2).mean()):.1e}, {int((off > 1e-5).sum())} voxels above 1e-5"


def compare(scan, out):
    print("| spec | processes × threads | method, s | peak of each, MiB | sent, MiB | off, of the largest voxel |")
    print("| --- | --- | --- | --- | --- | --- |")
    cores = os.cpu_count() or 1
    for spec in SPECS:
        for count in [1, 2, 4]:
            run, threads = out / f"{spec}-{count}", max(cores // count, 1)
            said, peak = peaks(command(count, threads, [scan, "--spec", spec, "-o", run, "--force"]))
            seconds = json.loads((run / "record.json").read_text())["train_s"]
            sent = re.search(r"sent ([\d.]+ \w+) to", said)
            off = differences(volume(run), volume(out / f"{spec}-1")) if count > 1 else ""
            every = ", ".join(f"{mib:.0f}" for mib in sorted(peak))
            print(f"| `{spec}` | {count} × {threads} | {seconds:.2f} | {every} | {sent[1] if sent else ''} | {off} |", flush=True)


def kill(scan, out, kills):
    spec, run, done, passes = "smooth-tv", out / "killed", 0, []
    subprocess.run(["rm", "-rf", run], check=True)
    random.seed(5)
    while not (run / "record.json").exists():
        resume = ["--resume"] if (run / "checkpoint.safetensors").exists() else ["--force"]
        arguments = [scan, "--spec", spec, "-o", run, "--checkpoint-every", "0.3s", *resume]
        start = command(random.choice([1, 2, 3, 4]), 1, arguments)
        running = subprocess.Popen(start, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done < kills:
            time.sleep(random.uniform(0.6, 3.0))
            victims = processes()
            if running.poll() is None and victims:
                os.kill(random.choice(victims), signal.SIGKILL)
                done += 1
        said = running.communicate()[0]
        finished = (run / "record.json").exists()
        assert finished or not list(run.glob("volume*")), "a volume of a run that did not end"
        assert finished or "exited on signal 9" in said, said
        passes += [int(n) for n in re.findall(r"resumed after pass (\d+)", said)]
    print(f"\n{done} kills, resumed after passes {passes}: {differences(volume(run), volume(out / f'{spec}-1'))}")


def main():
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    build = ["cargo", "build", "--release", "--quiet", "--bin", "conefield", "--features", "conefield-cli/mpi"]
    subprocess.run(build, cwd=ROOT, check=True)
    scan = out / "scan"
    if not scan.exists():
        simulate = ["simulate", "phantom:head:128", "--views", "50", "--detector", "256x256", "--noise", "tigre:1e5,10", "-o", scan]
        subprocess.run([BINARY, *map(str, simulate)], check=True)
    compare(scan, out)
    if len(sys.argv) > 2:
        kill(scan, out, int(sys.argv[2]))


main()
