"""
One GPU: is a captured update the eager one, what does it cost, how long is a run of Atari 100K, how many fit side by side?

    PYTHONPATH=. python examples/gpu_speed.py --json gpu.json                # check and steps, some minutes
    PYTHONPATH=. python examples/gpu_speed.py --json gpu.json --parts run    # again, until it is done; so with bbf
    PYTHONPATH=. python examples/gpu_speed.py --json gpu.json --parts seeds
    PYTHONPATH=. python examples/gpu_speed.py --json smoke.json --device cpu --smoke --parts check steps run bbf seeds

A part begins nothing new after --minutes, writes what it finds at once and leaves the other parts of the file alone. What a
run has done lies in --folder, and the next call goes on from there; delete it to begin anew.

A bare machine that has PyTorch with CUDA and no network takes five steps, the first one elsewhere:

    WHEELS="stable-baselines3 sb3-contrib gymnasium farama-notifications cloudpickle ale-py opencv-python-headless pyyaml"
    pip download --no-deps --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 -d wheels $WHEELS
    # Copy this repository and wheels/ there. Version and platform are those of its Python; leave out what it has already.
    pip install --no-index --no-deps --find-links wheels $WHEELS
    PYTHONPATH=. python -c "import sb3_eqr, ale_py, cv2, yaml, torch; print(torch.cuda.get_device_name())"
    PYTHONPATH=. python examples/gpu_speed.py --json gpu.json
"""

import argparse
import json
import multiprocessing
import os
import pathlib
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch as th
from stable_baselines3.common.logger import configure

from sb3_eqr import EqRRainbow, load_configuration
from sb3_eqr.benchmark.speed.clock import now, take_turns
from sb3_eqr.benchmark.speed.floor import Floor
from sb3_eqr.benchmark.speed.tables import Table
from sb3_eqr.benchmark.speed.workload import EQR_AGENTS, STEPS_PER_CALL, close, fill, make_agent, train
from sb3_eqr.common.save_util import atomic_write
from sb3_eqr.envs import make_atari100k_env

Job = argparse.Namespace  # the command line's, with `sizes` and `deadline`
GAME, ATARI_100K, SETTLED = "Pong", 100_000, 12  # the last: updates after which an update is captured
PARAMETERS_BAR, RELATIVE_BAR, ABSOLUTE_BAR = 1e-5, 0.05, 1e-3  # the latter two of losses by bf16, as in tests/test_fast.py
STARTED_BY = 150.0  # seconds for processes to start, learn a little and capture
SPAWN = multiprocessing.get_context("spawn")
FULL = {"agent": {}, "run": {}, "bbf": {}, "stored": 2_500, "updates": 100, "rounds": 7, "calls": 25, "matrix": 8_192}
FULL |= {"starts": 200, "steps": 500, "total": ATARI_100K, "processes": (1, 4, 8, 16), "seconds": 40.0}
SMOKE = {**FULL, "stored": 60, "updates": 16, "rounds": 2, "calls": 1, "matrix": 64, "starts": 20, "steps": 30, "total": 60}
SMOKE |= {"agent": {"batch_size": 4, "prediction_depth": 1, "buffer_size": 300}, "processes": (1, 2), "seconds": 2.0}
SMOKE |= {"run": {"learning_starts": 30}, "bbf": {"learning_starts": 50, "policy_kwargs": {"net_arch": [32]}}}
WAYS: dict[str, dict[str, Any]] = {"eager": {"fast": "off"}, "captured": {"fast": "graph"}}
WAYS |= {"captured + bf16": {"fast": "graph", "bf16": True}, "captured + overlap": {"fast": "overlap"}}


def table(name: str, title: str, rows: list[dict[str, Any]], *notes: str) -> Table:
    """A column for each key."""
    formats = {key: ".4g" if any(isinstance(row[key], float) for row in rows) else "" for key in rows[0]}
    return Table(name, title, formats, rows, list(notes))


def updated(job: Job, name: str, n_updates: int, **kwargs: Any) -> Any:
    """An agent past its first updates; between them new frames come in, and the ring of the buffer comes round."""
    model = make_agent(name, device=job.device, **{**job.sizes.agent, "buffer_size": job.sizes.stored + 5, **kwargs})
    fill(model.replay_buffer, job.sizes.stored)
    while model._n_updates < n_updates:
        train(model)
        fill(model.replay_buffer, 1)
    return model


def has_graph(model: Any) -> bool:
    """Whether its update was captured."""
    return any(capture.graph is not None for capture in model._captured._captures.values())


def check_parameters(job: Job) -> Table:
    """Beside eager against itself: additions in any order are not the graph's fault."""
    rows: list[dict[str, Any]] = []
    for name in EQR_AGENTS:
        for kind in ("deterministic", "as they are"):
            th.use_deterministic_algorithms(kind == "deterministic", warn_only=True)
            models = [updated(job, name, job.sizes.updates, fast=fast) for fast in ("off", "off", "graph")]
            th.use_deterministic_algorithms(False)
            eager, again, captured = (th.cat([p.detach().flatten() for p in m.policy.parameters()]) for m in models)
            off = {"eager_again": (again - eager).abs().max().item(), "captured": (captured - eager).abs().max().item()}
            graph, failure = has_graph(models[2]), models[2]._captured.failure
            ok = off["captured"] <= PARAMETERS_BAR and (graph or job.device == "cpu")
            rows.append({"name": name, "algorithms": kind, **off, "has_graph": graph, "fell_back": failure, "ok": ok})
    title = f"Parameters after {job.sizes.updates} updates from one seed: greatest difference from the eager ones"
    return table("parameters", title, rows, f"bar: {PARAMETERS_BAR}; cuDNN is deterministic in both, by SB3's seeding")


def check_bf16(job: Job) -> Table:
    """The same samples and draws in both precisions."""
    rows: list[dict[str, Any]] = []
    for name in EQR_AGENTS:
        model = updated(job, name, job.sizes.updates, fast="off")
        model.policy.set_training_mode(True)
        samples, found = model.replay_buffer.sample(64), {}
        for model.bf16 in (False, True):
            th.manual_seed(0)
            td, auxiliary = model._compute_losses(samples)
            found[model.bf16] = {k: x.mean().item() for k, x in {"td": td.loss, **auxiliary._asdict()}.items()}
        for loss, full in found[False].items():
            off = abs(found[True][loss] - full)
            ok, relative = off <= RELATIVE_BAR * abs(full) + ABSOLUTE_BAR, off / abs(full) if full else None
            rows.append({"name": name, "loss": loss, "float32": full, "bf16": found[True][loss], "off": relative, "ok": ok})
    return table("bf16", "Losses of 64 samples", rows, f"bar: {RELATIVE_BAR:.0%} off, or {ABSOLUTE_BAR}")


def two_updates(model: Any, device: str) -> dict[str, Any]:
    """Captured, as a round has them, after a new frame has come in."""
    if not has_graph(model):
        why = model._captured.failure or f"no graph on {device}"
        return {"host_ms": None, "done_ms": None, "waits": f"not checked: {why}", "ok": None}
    model._late.write_back()
    waits, start = "no", now(device)
    th.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(2):
            model._late.write_back(but=1)
            model._run_captured(model.replay_buffer.draw(model.batch_size))
    except RuntimeError as error:
        waits = f"yes: {str(error).splitlines()[0]}"
    finally:
        th.cuda.set_sync_debug_mode("default")
    host = time.perf_counter() - start
    return {"host_ms": 1e3 * host, "done_ms": 1e3 * (now(device) - start), "waits": waits, "ok": waits == "no"}


def check_waits(job: Job) -> Table:
    """By PyTorch's own watch, and by the clock."""
    rows = [{"name": n, **two_updates(updated(job, n, SETTLED, fast="overlap"), job.device)} for n in EQR_AGENTS]
    note = "host ms: until the host goes on; PyTorch's watch misses waits for events, the clock does not"
    return table("waits", "Does the host wait for the GPU between two updates?", rows, note)


def check(job: Job) -> Iterator[Table]:
    """Captured is eager, bf16 agrees, nothing waits."""
    yield from (part(job) for part in (check_parameters, check_bf16, check_waits) if time.time() < job.deadline)


def rate(call: Callable[[], object], flop: float, device: str) -> float:
    """TFLOP per second."""
    return flop / take_turns({"": lambda: [call() for _ in range(10)]}, 3, 10, device)[""].best / 1e9


def measure_rates(job: Job) -> Table:
    """What a large product and a large convolution reach."""
    size, rows = job.sizes.matrix, []
    before = th.backends.cuda.matmul.allow_tf32, th.backends.cudnn.allow_tf32
    for kind in ("float32", "tf32", "bf16"):
        th.backends.cuda.matmul.allow_tf32 = th.backends.cudnn.allow_tf32 = kind == "tf32"
        like = {"device": job.device, "dtype": th.bfloat16 if kind == "bf16" else th.float32}
        matrix = th.randn(size, size, **like)
        images = th.randn(size // 32, 64, 84, 84, **like).to(memory_format=th.channels_last)
        filters = th.randn(128, 64, 3, 3, **like).to(memory_format=th.channels_last)
        product = rate(partial(th.mm, matrix, matrix), 2 * size**3, job.device)
        flop = 2 * 64 * 9 * 128 * 84 * 84 * len(images)
        convolution = rate(partial(th.conv2d, images, filters, padding=1), flop, job.device)
        rows.append({"precision": kind, "product": product, "convolution": convolution})
    th.backends.cuda.matmul.allow_tf32, th.backends.cudnn.allow_tf32 = before
    return table("rates", f"TFLOP/s reached: {size}×{size} by {size}×{size}, 3×3 convolution from 64 to 128", rows)


def launches(model: Any) -> dict[str, float | None]:
    """What the launches of an eager update take if nothing else does."""
    if model.device.type != "cuda":
        return {"ceiling: launches": None}
    with th.profiler.profile(activities=list(th.profiler.supported_activities())) as profile:
        train(model)
        th.cuda.synchronize()
    found = [event.count for event in profile.key_averages() if "Launch" in event.key and "Kernel" in event.key]
    empty = take_turns({"": lambda: [th.cuda._sleep(0) for _ in range(10_000)]}, 3, 10_000, "cuda")[""].best  # ms
    n = sum(found) / STEPS_PER_CALL
    return {f"ceiling: {n:,.0f} launches of {1e3 * empty:.2f} us": n * empty or None}  # 0: the profiler sees none


def measure_updates(job: Job, name: str, rates: Table) -> Table:
    """All ways in turns, beside the ceilings."""
    n_updates = job.sizes.calls * STEPS_PER_CALL
    models = {way: updated(job, name, SETTLED, **kwargs) for way, kwargs in WAYS.items()}
    floor = Floor(models["eager"])
    works: dict[str, Callable[[], object]] = {"its convolutions, eager": partial(floor.steps, n_updates)}
    for way, model in models.items():
        works[way] = lambda model=model: [train(model) for _ in range(job.sizes.calls)]
    timed = take_turns(works, job.sizes.rounds, n_updates, job.device)
    failures = {way: model._captured.failure for way, model in models.items()}
    rows = [{"way": w, "ms": s.median, "best": s.best, "fell_back": failures.get(w)} for w, s in timed.items()]
    ceilings = launches(models["eager"])
    for row in rates.rows:
        ceilings[f"ceiling: {floor.flop / 1e9:.2f} GFLOP, {row['precision']}"] = floor.flop / row["convolution"] / 1e9
    rows += [{"way": way, "ms": ms, "best": None, "fell_back": None} for way, ms in ceilings.items()]
    note = "arithmetic at the rate of the large convolution; as it is, PyTorch uses TF32 in convolutions, not in products"
    return table(f"updates_{name}", f"{name}: milliseconds per update, 84×84×4", rows, note)


def pong(job: Job, **kwargs: Any) -> Any:
    """EqRRainbow on the game; nothing is logged."""
    settings = {"seed": 0, "device": job.device, "bf16": job.bf16, **job.sizes.agent, **kwargs}
    model = EqRRainbow("CnnPolicy", make_atari100k_env(GAME, seed=settings["seed"]), **settings)
    model.set_logger(configure(None, []))
    return model


def learn(model: Any, n_steps: int, deadline: float = float("inf")) -> float:
    """Go on, for so many steps or until then; seconds."""
    start = now(str(model.device))
    model.learn(n_steps, callback=lambda *_: time.time() < deadline, reset_num_timesteps=False)
    return now(str(model.device)) - start


def learning(job: Job, **kwargs: Any) -> Any:
    """An agent of which every further step is one of learning: past the random ones, and captured."""
    model = pong(job, learning_starts=job.sizes.starts, exploration_initial_eps=0.0, **kwargs)
    learn(model, job.sizes.starts + SETTLED)
    return model


def measure_env_steps(job: Job) -> Table:
    """Of the emulator alone, then with acting, storing and two updates."""
    n, env = job.sizes.steps, make_atari100k_env(GAME, seed=0)
    env.reset()
    start = time.perf_counter()
    for _ in range(n):
        env.step([env.action_space.sample()])
    found = {f"{GAME} alone": n / (time.perf_counter() - start)}
    for way, kwargs in WAYS.items():
        model = learning(job, **kwargs)
        found[way] = n / learn(model, n)
        close(model)
    rows = [{"way": way, "steps_per_second": rate, "minutes_per_run": ATARI_100K / rate / 60} for way, rate in found.items()]
    return table("env_steps", f"Steps of the environment per second, EqRRainbow, over {n}", rows)


def steps(job: Job) -> Iterator[Table]:
    """What a step and an update cost."""
    rates = measure_rates(job)
    yield rates
    parts = [measure_env_steps, *(partial(measure_updates, name=name, rates=rates) for name in EQR_AGENTS)]
    yield from (part(job) for part in parts if time.time() < job.deadline)


def whole_run(job: Job, name: str, bar: int) -> Iterator[Table]:
    """As far as the time goes, from where the last call has stopped; evaluation, loading and saving apart."""
    settings = load_configuration("eqr_bbf", **job.sizes.bbf) if name == "bbf" else job.sizes.run
    file, total = job.folder / f"{name}{'_bf16' * job.bf16}{'_smoke' * job.smoke}", job.sizes.total
    model = pong(job, fast="overlap", **settings)
    model.seconds_so_far, model.calls_so_far = 0.0, 0  # saved with the model
    if file.with_suffix(".zip").is_file():
        model = EqRRainbow.load(file, env=model.get_env(), device=job.device)
        model.load_replay_buffer(file)
        model.set_logger(configure(None, []))
    if model.num_timesteps < total:
        model.seconds_so_far += learn(model, total - model.num_timesteps, job.deadline)
        model.calls_so_far += 1
        model.save_replay_buffer(file)
        model.save(file)
    done, n, seconds = model.num_timesteps, model._n_updates, model.seconds_so_far
    left = model.gradient_steps * (total - max(done, model.learning_starts))
    projected = seconds * (1 + left / n) if n else None  # random steps cost next to nothing
    memory = None if job.device == "cpu" else th.cuda.max_memory_reserved() / 1e9
    row = {"run": file.name, "steps": done, "of": total, "updates": n, "calls": model.calls_so_far, "seconds": seconds}
    row |= {"steps_per_second": done / seconds, "projected_seconds": projected, "bar": bar, "gpu_gb": memory}
    row |= {"fell_back": model._captured.failure, "ok": None if projected is None else projected <= bar}
    yield table(name, f"{GAME}, M = {model.depth}: {'done' if done >= total else 'the same command goes on'}", [row])


def gpu_gb(job: Job) -> float:
    """What all processes together have taken of the GPU's memory."""
    free, whole = (0, 0) if job.device == "cpu" else th.cuda.mem_get_info()
    return (whole - free) / 1e9


def one_of_many(job: Job, seed: int, barrier: Any, answers: Any) -> None:
    """A process: ready, all together, go."""
    th.set_num_threads(1)
    model = learning(job, fast="overlap", seed=seed)
    barrier.wait(timeout=STARTED_BY)
    taken, before = gpu_gb(job), model.num_timesteps
    seconds = learn(model, ATARI_100K, time.time() + job.sizes.seconds)
    answers.put(((model.num_timesteps - before) / seconds, taken))


def seeds(job: Job) -> Iterator[Table]:
    """Processes side by side on one GPU."""
    rows: list[dict[str, Any]] = []
    for n in job.sizes.processes:
        if time.time() > job.deadline:
            break
        barrier, answers, taken = SPAWN.Barrier(n), SPAWN.Queue(), gpu_gb(job)
        for seed in range(n):
            SPAWN.Process(target=one_of_many, args=(job, seed, barrier, answers), daemon=True).start()
        rates, memory = zip(*(answers.get(timeout=STARTED_BY + 2 * job.sizes.seconds) for _ in range(n)), strict=True)
        for process in multiprocessing.active_children():
            process.join()
        each = {"slowest": min(rates), "gpu_gb_each": (max(memory) - taken) / n}
        rows.append({"processes": n, "runs_per_hour": sum(rates) * 3600 / ATARI_100K, **each})
        yield table("seeds", "Processes of one agent each, with overlap, on one GPU; steps per second of the slowest", rows)


PARTS: dict[str, Callable[[Job], Iterator[Table]]] = {"check": check, "steps": steps, "seeds": seeds}
PARTS |= {name: partial(whole_run, name=name, bar=60 * bar) for name, bar in (("run", 6), ("bbf", 30))}


def about(job: Job) -> dict[str, Any]:
    """What figures depend on."""
    gpu = None if job.device == "cpu" else th.cuda.get_device_name()
    driver = subprocess.getoutput("nvidia-smi --query-gpu=driver_version --format=csv,noheader") if gpu else None
    found = {"gpu": gpu, "driver": driver, "cuda": th.version.cuda, "torch": th.__version__, "python": sys.version.split()[0]}
    found |= {"cpus": os.cpu_count(), "threads": th.get_num_threads(), "command": " ".join(sys.argv), "smoke": job.smoke}
    return {**found, "bf16": job.bf16, "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())}


def measure(job: Job, part: str) -> bool:
    """Write each table when it is there, print all in the end; whether nothing went wrong."""
    start, tables = time.time(), {}
    found: dict[str, Any] = {"about": about(job), "tables": {}, "error": None}
    job.deadline = start + 60 * job.minutes
    others = json.loads(job.json.read_text()) if job.json.is_file() else {}

    def write() -> None:
        found["seconds"] = round(time.time() - start, 1)
        with atomic_write(job.json, "json") as file:
            file.write(json.dumps({**others, part: found}, indent=2).encode())

    try:
        for table in PARTS[part](job):
            tables[table.name], found["tables"][table.name] = table, table.data()
            write()
    except Exception:  # lent minutes: the other parts are still to be had
        found["error"] = traceback.format_exc()
        write()
    print(f"\n# {part}, {found['seconds']} seconds", *(table.text() for table in tables.values()), sep="\n\n", flush=True)
    print(found["error"] or "", file=sys.stderr, flush=True)
    return found["error"] is None


def main() -> None:
    """Every part that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split("\n")[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=["check", "steps"], help="(default: check steps)")
    parser.add_argument(
        "--json", type=lambda name: pathlib.Path(name).with_suffix(".json"), default="gpu_speed", metavar="FILE"
    )
    parser.add_argument("--folder", type=pathlib.Path, default=pathlib.Path("gpu_runs"), help="of checkpoints")
    parser.add_argument("--minutes", type=float, default=8.0, help="of each part (default: 8)")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--bf16", action="store_true", help="in run, bbf and seeds")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does the script run?")
    job = parser.parse_args()
    if job.device == "cuda" and not th.cuda.is_available():
        parser.error("--device: PyTorch sees no GPU here; --device cpu --smoke tries the script")
    job.sizes = argparse.Namespace(**(SMOKE if job.smoke else FULL))
    os.environ |= {"OMP_NUM_THREADS": "1", "CUBLAS_WORKSPACE_CONFIG": ":4096:8"}  # of processes, of deterministic products
    sys.exit(not all([measure(job, part) for part in job.parts]))


if __name__ == "__main__":
    main()
