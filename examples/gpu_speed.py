"""
Compare eager updates with updates captured as a CUDA graph (``cuda_graph=True``), on one GPU.

    PYTHONPATH=. python examples/gpu_speed.py                   # check and steps, a few minutes
    PYTHONPATH=. python examples/gpu_speed.py --parts run       # Atari 100K on Pong; the same command resumes it
    PYTHONPATH=. python examples/gpu_speed.py --parts seeds     # several runs in parallel
    PYTHONPATH=. python examples/gpu_speed.py --device cpu --smoke --parts check steps run seeds   # does the script run?

``run`` and ``seeds`` capture their updates, unless ``--eager`` is given. Tables are printed, and added to those of earlier
calls in ``--json``. The exit status is 1 if ``check`` fails.
"""

import argparse
import json
import multiprocessing
import pathlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch as th
from stable_baselines3.common.logger import configure
from torch.utils.benchmark import timer

from experiments.clock import Table, median, take_turns
from experiments.workload import EQR_AGENTS, Floor, fill, make_agent
from sb3_eqr import EqRRainbow
from sb3_eqr.common.saving.files import atomic_write
from sb3_eqr.envs import make_atari100k_env

Job = argparse.Namespace  # the command-line options, and ``sizes``
GAME, ATARI_100K, WAYS = "Pong", 100_000, {"eager": False, "captured": True}
STEPS_PER_CALL = 2  # updates per environment step, Table 5
WARM_UP = 12  # updates, by the end of which the graph is captured
TOLERANCE = 1e-5  # of parameters, if eager updates are deterministic
START_UP = 150.0  # seconds for processes to start, to train a little and to capture
SPAWN = multiprocessing.get_context("spawn")
FULL: dict[str, Any] = {"agent": {}, "stored": 2_500, "updates": 100, "rounds": 7, "calls": 25, "starts": 200, "steps": 500}
FULL |= {"total": ATARI_100K, "learning_starts": 2_000, "processes": (1, 4, 8, 16), "seconds": 40.0}
SMOKE = {**FULL, "stored": 60, "updates": 16, "rounds": 2, "calls": 1, "starts": 20, "steps": 30, "total": 60, "seconds": 2.0}
SMOKE |= {"agent": {"batch_size": 4, "prediction_depth": 1, "buffer_size": 300}, "learning_starts": 30, "processes": (1, 2)}


def train(model: Any) -> None:
    """The updates of one environment step."""
    model.train(STEPS_PER_CALL, model.batch_size)


def capture_of(model: Any) -> str:
    """The state of ``cuda_graph=True``: "captured", or why updates are eager."""
    found = model._captured
    return "not asked for" if found is None else found.failure or ("captured" if found._graph else "not yet captured")


def updated(job: Job, name: str, n_updates: int, cuda_graph: bool) -> Any:
    """An agent after some updates on random frames. Frames are added between updates, so that old ones are overwritten."""
    kwargs = {**job.sizes["agent"], "buffer_size": job.sizes["stored"] + 5}
    model = make_agent(name, device=job.device, cuda_graph=cuda_graph, **kwargs)
    fill(model.replay_buffer, job.sizes["stored"])
    while model._n_updates < n_updates:
        train(model)
        fill(model.replay_buffer, 1)
    return model


def check(job: Job) -> Iterator[Table]:
    """Check that captured updates differ from eager ones no more than eager ones differ from their own repetition."""
    rows = []
    for name in EQR_AGENTS:
        models = [updated(job, name, job.sizes["updates"], cuda_graph) for cuda_graph in (False, False, True)]
        eager, again, captured = (th.cat([p.detach().flatten() for p in model.policy.parameters()]) for model in models)
        apart_again, apart = (again - eager).abs().max().item(), (captured - eager).abs().max().item()
        capture = capture_of(models[2])
        ok = apart <= max(TOLERANCE, 2 * apart_again) and (capture == "captured" or job.device == "cpu")
        rows.append({"name": name, "eager_again": apart_again, "captured": apart, "capture": capture, "ok": ok})
    title = f"Parameters after {job.sizes['updates']} updates from one seed: largest difference from the eager ones"
    yield Table("parameters", title, rows, [f"tolerance: {TOLERANCE}, or twice the difference between two eager agents"])


def steps(job: Job) -> Iterator[Table]:
    """The time of an update, and of an environment step with its updates."""
    n_calls = job.sizes["calls"]
    for name in EQR_AGENTS:
        models = {way: updated(job, name, WARM_UP, cuda_graph) for way, cuda_graph in WAYS.items()}
        floor = Floor(models["eager"])
        works: dict[str, Callable[[], object]] = {"floor": lambda floor=floor: floor.steps(n_calls * STEPS_PER_CALL)}
        works |= {way: lambda model=model: [train(model) for _ in range(n_calls)] for way, model in models.items()}
        timed = take_turns(works, job.sizes["rounds"], n_calls * STEPS_PER_CALL)
        rows = [{"way": way, "ms": median(series.ms), "best_ms": float(series.ms.min())} for way, series in timed.items()]
        notes = [floor.description(), f"cuda_graph=True: {capture_of(models['captured'])}"]
        yield Table(f"updates_{name}", f"{name}: milliseconds per update, 84x84x4", rows, notes)
    rows = []
    for way, cuda_graph in WAYS.items():
        model = learning(job, cuda_graph=cuda_graph)
        rate = job.sizes["steps"] / learn(model, job.sizes["steps"])
        rows.append({"way": way, "steps_per_second": rate, "minutes_per_100K": ATARI_100K / rate / 60})
        model.env.close()
    yield Table("env_steps", f"Environment steps per second: EqRRainbow on {GAME}, two updates per step", rows)


def make_run(job: Job, **kwargs: Any) -> Any:
    """An agent on the game, which logs nothing."""
    settings = {"seed": 0, "device": job.device, "cuda_graph": not job.eager, **job.sizes["agent"], **kwargs}
    model = EqRRainbow("CnnPolicy", make_atari100k_env(GAME, seed=settings["seed"]), **settings)
    model.set_logger(configure(None, []))
    return model


def learn(model: Any, n_steps: int, deadline: float = float("inf")) -> float:
    """Train for ``n_steps`` or until ``deadline``; returns the elapsed seconds."""
    start = timer()  # waits for the GPU
    model.learn(n_steps, callback=lambda *_: time.time() < deadline, reset_num_timesteps=False)
    return timer() - start


def learning(job: Job, **kwargs: Any) -> Any:
    """An agent after its random steps, whose updates are already captured."""
    model = make_run(job, learning_starts=job.sizes["starts"], exploration_initial_eps=0.0, **kwargs)
    learn(model, job.sizes["starts"] + WARM_UP)
    return model


def run(job: Job) -> Iterator[Table]:
    """Atari 100K: train for ``--minutes``, resuming the last call's run, and save."""
    path, total = job.folder / f"{GAME}{'_eager' * job.eager}{'_smoke' * job.smoke}", job.sizes["total"]
    model = make_run(job, learning_starts=job.sizes["learning_starts"])
    model.seconds_so_far = 0.0  # saved with the model
    if path.with_suffix(".zip").is_file():
        model = EqRRainbow.load(path, env=model.get_env(), device=job.device)
        model.load_replay_buffer(path)
        model.set_logger(configure(None, []))
    if model.num_timesteps < total:
        model.seconds_so_far += learn(model, total - model.num_timesteps, time.time() + 60 * job.minutes)
        model.save_replay_buffer(path)
        model.save(path)
    row = {"steps": model.num_timesteps, "of": total, "updates": model._n_updates, "seconds": model.seconds_so_far}
    row |= {"steps_per_second": model.num_timesteps / model.seconds_so_far, "capture": capture_of(model)}
    yield Table("run", f"{GAME}, {'eager' if job.eager else 'captured'}; saving and loading not counted", [row])


def one_of_many(job: Job, seed: int, barrier: Any, rates: Any) -> None:
    """One process: train once all processes are ready, and report the environment steps per second."""
    th.set_num_threads(1)
    model = learning(job, seed=seed)
    before = model.num_timesteps
    barrier.wait(timeout=START_UP)
    seconds = learn(model, ATARI_100K, time.time() + job.sizes["seconds"])
    rates.put((model.num_timesteps - before) / seconds)


def seeds(job: Job) -> Iterator[Table]:
    """Parallel runs, each in a separate process."""
    rows = []
    for n in job.sizes["processes"]:
        barrier, rates = SPAWN.Barrier(n), SPAWN.Queue()
        for seed in range(n):
            SPAWN.Process(target=one_of_many, args=(job, seed, barrier, rates), daemon=True).start()
        found = [rates.get(timeout=START_UP + 2 * job.sizes["seconds"]) for _ in range(n)]
        for process in multiprocessing.active_children():
            process.join()
        rows.append({"processes": n, "slowest_steps_per_second": min(found), "runs_per_hour": sum(found) * 3600 / ATARI_100K})
        yield Table("seeds", "Processes of one agent each on one device", rows)


PARTS: dict[str, Callable[[Job], Iterator[Table]]] = {"check": check, "steps": steps, "run": run, "seeds": seeds}


def main() -> None:
    """Measure the requested parts; print and write each table as soon as it is complete."""
    parser = argparse.ArgumentParser(description="Compare eager updates with updates captured as a CUDA graph.")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=["check", "steps"], help="default: check steps")
    parser.add_argument("--json", type=pathlib.Path, default=pathlib.Path("gpu_speed.json"), help="default: %(default)s")
    parser.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("gpu_runs"), help="folder of run's checkpoint")
    parser.add_argument("--minutes", type=float, default=8.0, help="training time of run in this call (default: 8)")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--eager", action="store_true", help="do not capture updates in run and seeds")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to test the script")
    job = parser.parse_args()
    if job.device == "cuda" and not th.cuda.is_available():
        parser.error("--device must be cpu, because PyTorch finds no GPU. --device cpu --smoke tests the script")
    job.sizes, failed = SMOKE if job.smoke else FULL, False
    about = {"torch": th.__version__, "cuda": th.version.cuda, "cpus": multiprocessing.cpu_count(), "smoke": job.smoke}
    about["device"] = "cpu" if job.device == "cpu" else th.cuda.get_device_name()
    for part in job.parts:
        for found in PARTS[part](job):
            print(f"\n{found.text()}", flush=True)
            failed |= not all(row.get("ok", True) for row in found.rows)
            tables = json.loads(job.json.read_text()) if job.json.is_file() else {}
            tables[found.name] = {**found._asdict(), "about": {**about, "command": " ".join(sys.argv)}}
            with atomic_write(job.json, "json") as file:
                file.write(json.dumps(tables, indent=2).encode())
    sys.exit(failed)


if __name__ == "__main__":
    main()
