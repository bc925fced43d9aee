"""Hostile, damaged and shared files, and a disk without space."""

import base64
import contextlib
import io
import json
import os
import pathlib
import pickle
import random
import resource
import shutil
import subprocess
import sys
import threading
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env

from experiments.attacks import Finding
from experiments.attacks.inputs import make
from sb3_eqr import EqRQRDQN, ExactCheckpointCallback
from sb3_eqr.benchmark.training import load_checkpoint
from sb3_eqr.common.saving.checkpoints import MANIFEST, checksum_of, digest, find_checkpoints
from sb3_eqr.visualize.loading import load_model, make_env

RAN = pathlib.Path("ran")  # the file that hostile code creates


class Runs:
    """Creates a file when it is unpickled."""

    def __reduce__(self) -> Any:
        return pathlib.Path.touch, (RAN,)


def trained(folder: pathlib.Path) -> Any:
    """Train an agent, and write its model, buffer and checkpoints into a folder."""
    model = make(env=make_vec_env("CartPole-v1"), seed=0)
    model.learn(120, ExactCheckpointCallback(50, folder / "checkpoints"))
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    return model


def repacked(source: pathlib.Path, path: pathlib.Path, changes: dict[str, bytes]) -> pathlib.Path:
    """Copy a zip file, replacing the contents of some members."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(path, "w") as copy:
        for name in archive.namelist():
            copy.writestr(name, changes.get(name, archive.read(name)))
    return path


def hostile(folder: pathlib.Path) -> Iterator[tuple[str, str, pathlib.Path]]:
    """Write the hostile files; yields name, kind and path of each."""
    evil, model = pickle.dumps(Runs()), folder / "model.zip"
    text = base64.b64encode(evil).decode()
    with zipfile.ZipFile(model) as archive:
        data = json.loads(archive.read("data"))
    forms = {
        "SB3's form": {":type:": "x", ":serialized:": text},
        "our form": {":kind:": "pickle", "type": "x", "pickle": text},
    }
    forms["a class of another package"] = {":kind:": "class", "module": "subprocess", "name": "Popen"}
    for form, value in forms.items():
        for place in ("policy_class", "policy_kwargs", "anything"):
            changed = json.dumps({**data, place: value}).encode()
            yield f"{place} in {form}", "model", repacked(model, folder / f"{form}_{place}.zip", {"data": changed})
    for member in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth"):
        yield f"a pickle as {member}", "model", repacked(model, folder / f"{member}.zip", {member: evil})
    pickled = folder / "pickled.pkl"
    pickled.write_bytes(evil)
    yield "a pickle as buffer", "buffer", pickled
    objects = folder / "objects.pkl"
    with open(objects, "wb") as file:
        np.savez(file, data=np.array([Runs()], dtype=object))
    yield "an array of objects as buffer", "buffer", objects
    pickle_of = {":kind:": "pickle", "type": "x", "pickle": text}
    yield from forged_buffers(folder, pickle_of)
    yield from forged_checkpoints(folder, pickle_of)
    yield from forged_models(folder, data)
    copy = copied_checkpoint(folder, "hostile_model")
    repacked(model, copy / "model.zip", {"policy.pth": evil})
    yield "a checkpoint with a hostile model", "checkpoint", copy
    beside = f"!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [{RAN.resolve()}]]"
    for name in ("args.yml", "config.yml", "vecnormalize.pkl"):
        run = folder / f"zoo_{name}"
        (run / "Env").mkdir(parents=True)
        shutil.copy(model, run / "model.zip")
        (run / "Env" / "args.yml").write_text(yaml.dump({"env": "CartPole-v1", "env_kwargs": None, "gym_packages": []}))
        (run / "Env" / "config.yml").write_text(yaml.dump({"policy": "MlpPolicy", "normalize": name.endswith("pkl")}))
        content = evil if name.endswith("pkl") else f"a: {beside}\nenv: CartPole-v1\n".encode()
        (run / "Env" / name).write_bytes(content)
        yield f"{name} of RL Zoo", "shown", run / "model.zip"


def forged_buffers(folder: pathlib.Path, pickle_of: dict[str, str]) -> Iterator[tuple[str, str, pathlib.Path]]:
    """Buffers with pickles, with numbers that are out of range, and with sizes that the file does not have."""
    source = folder / "buffer.pkl"
    with zipfile.ZipFile(source) as archive:
        whole = json.loads(archive.read("data"))
    shape = whole["state"]["rewards"]["shape"]
    changes: dict[str, Any] = {
        "a pickle": {"rewards": pickle_of},
        "a pickle as number": {"pos": pickle_of},
        "a position": {"pos": 10**9},
        "a size": {"buffer_size": 10**12},
        "a shape": {"rewards": {"dtype": "<f4", "shape": [10**12, 1]}},
        "a dtype": {"rewards": {"dtype": "|O", "shape": shape}},
        "another number of environments": {"n_envs": 10**6},
        "a discount": {"gamma": float("nan")},
    }
    for name, change in changes.items():
        changed = json.dumps({**whole, "state": {**whole["state"], **change}}).encode()
        yield f"{name} in a buffer", "buffer", repacked(source, folder / f"buffer_{name}.pkl", {"data": changed})
    yield "a compressed buffer", "buffer", bomb(source, folder / "compressed.pkl", "rewards")


def bomb(source: pathlib.Path, path: pathlib.Path, member: str) -> pathlib.Path:
    """Copy a zip file with one member replaced by three gigabytes of zeros, in three megabytes."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(path, "w", compresslevel=1) as copy:
        for name in archive.namelist():
            if name != member:
                copy.writestr(name, archive.read(name))
        info = zipfile.ZipInfo(member)
        info.compress_type = zipfile.ZIP_DEFLATED
        with copy.open(info, "w", force_zip64=True) as file:
            for _ in range(3 << 10):
                file.write(bytes(1 << 20))
    return path


def copied_checkpoint(folder: pathlib.Path, name: str, **changes: Any) -> pathlib.Path:
    """Copy the last checkpoint, with other entries of its manifest, whose checksums are right."""
    copy = folder / name
    shutil.copytree(find_checkpoints(folder / "checkpoints")[-1], copy)
    manifest = {**json.loads((copy / MANIFEST).read_text()), **changes}
    manifest["sha256"] = {path.name: checksum_of(path) for path in sorted(copy.iterdir()) if path.name != MANIFEST}
    del manifest["digest"]
    (copy / MANIFEST).write_text(json.dumps({**manifest, "digest": digest(manifest)}))
    return copy


def forged_checkpoints(folder: pathlib.Path, pickle_of: dict[str, str]) -> Iterator[tuple[str, str, pathlib.Path]]:
    """Checkpoints whose manifest names methods, generators out of range or pickles, and one with a pipe as a file."""
    whole = json.loads((find_checkpoints(folder / "checkpoints")[-1] / MANIFEST).read_text())
    walk: dict[str, Any] = {"__globals__": {"sys": {"modules": {"os": {"system": "touch ran"}}}}}
    for name in ("step", "reset", "render", "__class__", "__dict__", "unwrapped", "spec", "state", "np_random"):
        for value in (walk, pickle_of, {":kind:": "class", "module": "subprocess", "name": "Popen"}):
            state = json.loads(json.dumps(whole["environment"]))
            for layer in state["envs"][0]:
                layer[1][name] = value
            copy = copied_checkpoint(folder, f"walk_{name}_{len(json.dumps(value))}", environment=state)
            yield f"{name} in an environment's state", "checkpoint", copy
    rng = {
        **whole["rng"],
        "numpy": {":kind:": "tuple", "items": ["MT19937", whole["rng"]["numpy"]["items"][1], 10**6, 0, 0.0]},
    }
    yield "a generator beyond its array", "checkpoint", copied_checkpoint(folder, "rng", rng=rng)
    yield "a pickle as generator", "checkpoint", copied_checkpoint(folder, "rng_pickle", rng=pickle_of)
    deep = copied_checkpoint(folder, "deep")
    (deep / MANIFEST).write_text('{"a":' * 10**6)
    yield "deep JSON", "checkpoint", deep
    pipe = copied_checkpoint(folder, "pipe")
    (pipe / "model.zip").unlink()
    os.mkfifo(pipe / "model.zip")
    yield "a pipe as model", "checkpoint", pipe


def forged_models(folder: pathlib.Path, data: dict[str, Any]) -> Iterator[tuple[str, str, pathlib.Path]]:
    """Models that name an environment to import, describe huge networks, or have moments that do not fit."""
    model = folder / "model.zip"
    (folder / "trap_module.py").write_text(f"import pathlib\npathlib.Path({str(RAN.resolve())!r}).touch()\n")
    sys.path.append(str(folder))
    kwargs: dict[str, Any] = {
        "groups": {"group": " x ".join(["SE(2)"] * 100_000)},
        "a group of many blocks": {"group": "SE(2)^1000000000"},
        "blocks": {"n_blocks": 10**9},
        "layers": {"net_arch": [10**5, 10**5]},
        "a wide latent model": {"latent_hidden_dim": 10**6},
    }
    changes = {f"{name} in policy_kwargs": {"policy_kwargs": value} for name, value in kwargs.items()}
    changes |= {"env": {"env": "trap_module:CartPole-v1"}, "a huge buffer": {"buffer_size": 10**13}}
    for name, change in changes.items():
        yield name, "model", repacked(model, folder / f"{name}.zip", {"data": json.dumps({**data, **change}).encode()})
    deep = ('{"policy_kwargs":' + '{"a":' * 10**6).encode()
    yield "deep JSON in a model", "model", repacked(model, folder / "deep_data.zip", {"data": deep})
    for member in ("data", "policy.pth"):
        yield f"a compressed {member}", "model", bomb(model, folder / f"bomb_{member}.zip", member)
    with zipfile.ZipFile(model) as archive:
        optimizer = th.load(io.BytesIO(archive.read("policy.optimizer.pth")), weights_only=True)
    for shape in ((1,), (0,), (10_000,)):
        optimizer["state"][0]["exp_avg"] = th.zeros(shape)
        content = io.BytesIO()
        th.save(optimizer, content)
        changed = {"policy.optimizer.pth": content.getvalue()}
        yield f"moments of shape {shape}", "model", repacked(model, folder / f"moments_{shape}.zip", changed)


def load_paths(folder: pathlib.Path) -> dict[str, list[Callable[[pathlib.Path], Any]]]:
    """All functions that load a file, by kind of file."""
    model, env = make(), make_vec_env("CartPole-v1")
    into_run = make(env=make_vec_env("CartPole-v1"))
    return {
        "model": [
            EqRQRDQN.load,
            lambda path: EqRQRDQN.load(path, env=env),
            lambda path: EqRQRDQN.load(open(path, "rb")),
            lambda path: EqRQRDQN.load(f"{path.with_suffix('')}/"),
            lambda path: EqRQRDQN.load(f"{path.parent}//{path.stem}"),
            model.set_parameters,
            model.load_representation,
            load_model,
        ],
        "buffer": [model.load_replay_buffer, lambda path: model.load_replay_buffer(open(path, "rb"))],
        "checkpoint": [lambda path: EqRQRDQN.resume(path, env), lambda path: load_checkpoint(path, into_run)],
        "shown": [lambda path: make_env(load_model(path), path)],
    }


def trusting(kind: str) -> Callable[[pathlib.Path], Any]:
    """A function that loads a file with ``trust=True``."""
    if kind == "buffer":
        return lambda path: make().load_replay_buffer(path, trust=True)
    if kind == "shown":
        return lambda path: make_env(load_model(path), path, trust=True)
    return lambda path: EqRQRDQN.load(path, trust=True)


def runs_code(load: Callable[[pathlib.Path], Any], path: pathlib.Path) -> bool:
    """Whether loading a file, which may fail, runs the code that it names."""
    with contextlib.suppress(Exception), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        load(path)
    ran = RAN.exists()
    RAN.unlink(missing_ok=True)
    return ran


def strangers_files(folder: pathlib.Path) -> Finding:
    """Load each hostile file with each function for its kind."""
    folder.mkdir(parents=True)
    trained(folder)
    ways, wrong, tries, alive = load_paths(folder), [], 0, 0
    files = list(hostile(folder))
    slowest, before = 0.0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for name, kind, path in files:
        for number, load in enumerate(ways[kind]):
            tries += 1
            began = time.monotonic()
            if runs_code(load, path):
                wrong.append(f"{name}, way {number}: ran code")
            seconds = time.monotonic() - began
            slowest = max(slowest, seconds)
            if seconds > 10:
                wrong.append(f"{name}, way {number}: {seconds:.0f} seconds")
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # GB
    if most > 2:
        wrong.append(f"{most:.1f} GB, {before / 2**20:.1f} before")
    tries += 200
    if swapped(folder, 200):
        wrong.append("a file that is replaced while it is loaded: ran code")
    for _, kind, path in files:  # with trust=True they must run code, else they would prove nothing
        alive += runs_code(trusting(kind), path)
    test = f"{len(files)} hostile files, {tries} loads"
    found = f"{len(wrong)} did, {alive} ran code with trust; {slowest:.1f} s, {most:.1f} GB at most"
    return Finding(test, "0 run code without trust=True, or take 10 s or 2 GB", found, not wrong and alive > 0, tuple(wrong))


def swapped(folder: pathlib.Path, times: int) -> bool:
    """Whether loading a file that another thread replaces by a hostile one runs code."""
    good, evil = (folder / "model.zip").read_bytes(), (folder / "policy.pth.zip").read_bytes()
    path, is_over = folder / "swapped.zip", threading.Event()

    def swap() -> None:
        while not is_over.is_set():
            for content in (good, evil):
                (folder / "next").write_bytes(content)
                os.replace(folder / "next", path)

    path.write_bytes(good)
    thread = threading.Thread(target=swap)
    thread.start()
    ran = any([runs_code(EqRQRDQN.load, path) for _ in range(times)])
    is_over.set()
    thread.join()
    return ran


def damaged_files(folder: pathlib.Path, rng: random.Random) -> Finding:
    """Truncate each kind of file at 20 places and flip a bit at 20; loading must fail and leave the agent unchanged."""
    folder.mkdir(parents=True)
    model = trained(folder)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    size, env = model.replay_buffer.size(), model.get_env()
    checkpoint = find_checkpoints(folder / "checkpoints")[-1]
    loads: dict[pathlib.Path, Callable[[], Any]] = {
        folder / "model.zip": lambda: (model.set_parameters(folder / "model.zip"), EqRQRDQN.load(folder / "model.zip")),
        folder / "buffer.pkl": lambda: model.load_replay_buffer(folder / "buffer.pkl"),
    }
    loads |= {path: lambda: EqRQRDQN.resume(checkpoint, env) for path in sorted(checkpoint.iterdir())}
    wrong, count = [], 0
    for path, load in loads.items():
        whole = path.read_bytes()
        for kind in ["truncated"] * 20 + ["flipped"] * 20:
            place = rng.randrange(len(whole))
            changed = bytearray(whole)
            changed[place] ^= 1 << rng.randrange(8)
            path.write_bytes(whole[:place] if kind == "truncated" else bytes(changed))
            count += 1
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    load()
                wrong.append(f"{path.name}, {kind} at {place}: loaded")
            except Exception as error:
                if not str(error):
                    wrong.append(f"{path.name}, {kind} at {place}: {type(error).__name__} without a message")
            path.write_bytes(whole)
            is_same = all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
            if not is_same or model.replay_buffer.size() != size:
                wrong.append(f"{path.name}, {kind} at {place}: the agent has changed")
    must = "every one rejected, the model unchanged"
    return Finding(
        f"{count} damaged files of {len(loads)} kinds", must, f"{count - len(wrong)} rejected", not wrong, tuple(wrong)
    )


def shared_path(folder: pathlib.Path) -> Finding:
    """Save to one path and load from it in several threads."""
    folder.mkdir(parents=True)
    model = make()
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    wrong: list[str] = []
    counts = {"saves": 0, "loads": 0}

    def repeat(kind: str, times: int, call: Callable[[], Any]) -> None:
        for _ in range(times):
            try:
                call()
            except Exception as error:
                wrong.append(f"{kind}: {type(error).__name__}: {error}")
            counts[kind] += 1

    savers = [make(seed=seed) for seed in range(4)]
    threads = [threading.Thread(target=repeat, args=("saves", 24, lambda m=m: m.save(folder / "model"))) for m in savers]
    threads += [
        threading.Thread(target=repeat, args=("saves", 24, lambda m=m: m.save_replay_buffer(folder / "buffer")))
        for m in savers
    ]
    threads += [threading.Thread(target=repeat, args=("loads", 56, lambda: EqRQRDQN.load(folder / "model"))) for _ in range(4)]
    readers = [make() for _ in range(4)]
    threads += [
        threading.Thread(target=repeat, args=("loads", 56, lambda m=m: m.load_replay_buffer(folder / "buffer")))
        for m in readers
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    left = [str(path) for path in folder.rglob(".*")]
    found = f"{len(wrong)} failures, {len(left)} partial files"
    return Finding(
        f"threads on one path: {counts['saves']} saves, {counts['loads']} loads",
        "0 failures, 0 partial files",
        found,
        not wrong and not left,
        tuple(wrong[:10] + left),
    )


def full_disk(folder: pathlib.Path) -> Finding:
    """Run an agent whose checkpoints fill a small disk."""
    folder.mkdir(parents=True)
    test, must = "a full disk (tmpfs of 2 MB)", "the last checkpoint is intact, and the message says so"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)], capture_output=True)
    if mounted.returncode != 0:
        return Finding(test, must, "cannot mount here", False)
    try:
        model = make(env=make_vec_env("CartPole-v1"), seed=0, buffer_size=20_000)
        said = ""
        try:
            model.learn(4_000, ExactCheckpointCallback(50, folder / "checkpoints", keep=1_000))
        except OSError as error:
            said = str(error).replace(str(folder), "FOLDER")
        resumed = EqRQRDQN.resume(folder / "checkpoints", make_vec_env("CartPole-v1"))
        left = [str(path) for path in folder.rglob(".*")]
        holds = (
            "The last checkpoint, checkpoint-0" in said and "No space left" in said and resumed.num_timesteps > 0 and not left
        )
        return Finding(test, must, f"{said!r}; resumed at step {resumed.num_timesteps}", holds, tuple(left))
    finally:
        subprocess.run(["umount", str(folder)], check=False)
