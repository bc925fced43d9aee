"""Hostile files, and a disk without space."""

import base64
import contextlib
import io
import json
import os
import pathlib
import pickle
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

from experiments.attacks import Finding, make, partial_files
from sb3_eqr import EqRQRDQN, ExactCheckpointCallback
from sb3_eqr.benchmark.training import load_checkpoint
from sb3_eqr.common.saving.checkpoints import MANIFEST, checksum_of, digest, find_checkpoints
from sb3_eqr.visualize.loading import load_model, make_env

RAN = pathlib.Path("ran")  # the file that hostile code creates
Load = Callable[[pathlib.Path], Any]
Members = dict[str, bytes | None]  # of a zip file; None: three gigabytes of zeros, in three megabytes
Hostile = Iterator[tuple[str, str, pathlib.Path]]  # what the file is, its kind, its path


class Runs:
    """Creates a file when it is unpickled."""

    def __reduce__(self) -> Any:
        return pathlib.Path.touch, (RAN,)


EVIL = pickle.dumps(Runs())
PICKLE = {":kind:": "pickle", "type": "x", "pickle": base64.b64encode(EVIL).decode()}
POPEN = {":kind:": "class", "module": "subprocess", "name": "Popen"}
FORMS = {
    "SB3's form": {":type:": "x", ":serialized:": PICKLE["pickle"]},
    "our form": PICKLE,
    "a class of another package": POPEN,
}
DEEP = '{"a":' * 10**6
# Changes of a model's data: environments to import, huge networks.
POLICY_KWARGS: dict[str, dict[str, Any]] = {
    "groups": {"group": " x ".join(["SE(2)"] * 100_000)},
    "a group of many blocks": {"group": "SE(2)^1000000000"},
    "blocks": {"n_blocks": 10**9},
    "layers": {"net_arch": [10**5, 10**5]},
    "a wide latent model": {"latent_hidden_dim": 10**6},
}
MODELS: dict[str, dict[str, Any]] = {
    **{
        f"{place} in {form}": {place: FORMS[form]} for form in FORMS for place in ("policy_class", "policy_kwargs", "anything")
    },
    **{f"{name} in policy_kwargs": {"policy_kwargs": value} for name, value in POLICY_KWARGS.items()},
    "env": {"env": "trap_module:CartPole-v1"},
    "a huge buffer": {"buffer_size": 10**13},
}
# Changes of a buffer's state: pickles, numbers that are out of range, sizes that the file does not have.
BUFFERS: dict[str, dict[str, Any]] = {
    "a pickle": {"rewards": PICKLE},
    "a pickle as number": {"pos": PICKLE},
    "a position": {"pos": 10**9},
    "a size": {"buffer_size": 10**12},
    "a shape": {"rewards": {"dtype": "<f4", "shape": [10**12, 1]}},
    "a dtype": {"rewards": {"dtype": "|O", "shape": [500, 1]}},
    "another number of environments": {"n_envs": 10**6},
    "a discount": {"gamma": float("nan")},
}
WALK: dict[str, Any] = {"__globals__": {"sys": {"modules": {"os": {"system": "touch ran"}}}}}
ATTRIBUTES = ("step", "reset", "render", "__class__", "__dict__", "unwrapped", "spec", "state", "np_random")


def trained(folder: pathlib.Path) -> Any:
    """Train an agent, and write its model, buffer and checkpoints into a new folder."""
    folder.mkdir(parents=True)
    model = make(env=make_vec_env("CartPole-v1"), seed=0)
    model.learn(120, ExactCheckpointCallback(50, folder / "checkpoints"))
    model.save(folder / "model")
    model.save_replay_buffer(folder / "buffer")
    return model


def repacked(source: pathlib.Path, path: pathlib.Path, changes: Members) -> pathlib.Path:
    """Copy a zip file, replacing the contents of some members."""
    with zipfile.ZipFile(source) as archive, zipfile.ZipFile(path, "w", compresslevel=1) as copy:
        for name in archive.namelist():
            content = changes.get(name, archive.read(name))
            if content is not None:
                copy.writestr(name, content)
                continue
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_DEFLATED
            with copy.open(info, "w", force_zip64=True) as file:
                for _ in range(3 << 10):
                    file.write(bytes(1 << 20))
    return path


def forged_models(source: pathlib.Path) -> Iterator[tuple[str, Members]]:
    """Models with pickles, of a size that they do not have, or with moments that do not fit."""
    with zipfile.ZipFile(source) as archive:
        data = json.loads(archive.read("data"))
        optimizer = th.load(io.BytesIO(archive.read("policy.optimizer.pth")), weights_only=True)
    for name, change in MODELS.items():
        yield name, {"data": json.dumps({**data, **change}).encode()}
    for member in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth"):
        yield f"a pickle as {member}", {member: EVIL}
    yield "deep JSON in a model", {"data": f'{{"policy_kwargs":{DEEP}'.encode()}
    for member in ("data", "policy.pth"):
        yield f"a compressed {member}", {member: None}
    for shape in ((1,), (0,), (10_000,)):
        optimizer["state"][0]["exp_avg"] = th.zeros(shape)
        content = io.BytesIO()
        th.save(optimizer, content)
        yield f"moments of shape {shape}", {"policy.optimizer.pth": content.getvalue()}


def forged_buffers(source: pathlib.Path) -> Iterator[tuple[str, Members]]:
    """Buffers with the changes of the table, and one with compressed zeros."""
    with zipfile.ZipFile(source) as archive:
        whole = json.loads(archive.read("data"))
    for name, change in BUFFERS.items():
        yield f"{name} in a buffer", {"data": json.dumps({**whole, "state": {**whole["state"], **change}}).encode()}
    yield "a compressed buffer", {"rewards": None}


def copied_checkpoint(folder: pathlib.Path, name: str, **changes: Any) -> pathlib.Path:
    """Copy the last checkpoint, with other entries of its manifest, whose checksums are right."""
    copy = folder / name
    shutil.copytree(find_checkpoints(folder / "checkpoints")[-1], copy)
    manifest = {**json.loads((copy / MANIFEST).read_text()), **changes}
    manifest["sha256"] = {path.name: checksum_of(path) for path in sorted(copy.iterdir()) if path.name != MANIFEST}
    del manifest["digest"]
    (copy / MANIFEST).write_text(json.dumps({**manifest, "digest": digest(manifest)}))
    return copy


def forged_checkpoints(folder: pathlib.Path) -> Iterator[tuple[str, pathlib.Path]]:
    """Checkpoints whose manifest names methods, generators out of range or pickles; hostile JSON, pipe and model."""
    whole = json.loads((find_checkpoints(folder / "checkpoints")[-1] / MANIFEST).read_text())
    for name in ATTRIBUTES:
        for number, value in enumerate((WALK, PICKLE, POPEN)):
            state = json.loads(json.dumps(whole["environment"]))
            for layer in state["envs"][0]:
                layer[1][name] = value
            copy = copied_checkpoint(folder, f"walk_{name}_{number}", environment=state)
            yield f"{name} in an environment's state", copy
    items = ["MT19937", whole["rng"]["numpy"]["items"][1], 10**6, 0, 0.0]
    rng = {**whole["rng"], "numpy": {":kind:": "tuple", "items": items}}
    yield "a generator beyond its array", copied_checkpoint(folder, "rng", rng=rng)
    yield "a pickle as generator", copied_checkpoint(folder, "rng_pickle", rng=PICKLE)
    deep, pipe, other = (copied_checkpoint(folder, name) for name in ("deep", "pipe", "hostile_model"))
    (deep / MANIFEST).write_text(DEEP)
    yield "deep JSON", deep
    (pipe / "model.zip").unlink()
    os.mkfifo(pipe / "model.zip")
    yield "a pipe as model", pipe
    repacked(folder / "model.zip", other / "model.zip", {"policy.pth": EVIL})
    yield "a checkpoint with a hostile model", other


def forged_folders(folder: pathlib.Path) -> Iterator[tuple[str, pathlib.Path]]:
    """Models with the files of RL Zoo, one of which runs code."""
    touch = f"!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [{RAN.resolve()}]]"
    for name in ("args.yml", "config.yml", "vecnormalize.pkl"):
        run, is_pickle = folder / f"zoo_{name}", name.endswith("pkl")
        (run / "Env").mkdir(parents=True)
        shutil.copy(folder / "model.zip", run / "model.zip")
        (run / "Env" / "args.yml").write_text(yaml.dump({"env": "CartPole-v1", "env_kwargs": None, "gym_packages": []}))
        (run / "Env" / "config.yml").write_text(yaml.dump({"policy": "MlpPolicy", "normalize": is_pickle}))
        (run / "Env" / name).write_bytes(EVIL if is_pickle else f"a: {touch}\nenv: CartPole-v1\n".encode())
        yield f"{name} of RL Zoo", run / "model.zip"


def hostile(folder: pathlib.Path) -> Hostile:
    """Write the hostile files beside the model, buffer and checkpoints of :func:`trained`."""
    (folder / "trap_module.py").write_text(f"import pathlib\npathlib.Path({str(RAN.resolve())!r}).touch()\n")
    sys.path.append(str(folder))
    model, buffer = folder / "model.zip", folder / "buffer.pkl"
    for name, members in forged_models(model):
        yield name, "model", repacked(model, folder / f"{name}.zip", members)
    for name, members in forged_buffers(buffer):
        yield name, "buffer", repacked(buffer, folder / f"{name}.pkl", members)
    pickled, objects = folder / "pickled.pkl", io.BytesIO()
    pickled.write_bytes(EVIL)
    yield "a pickle as buffer", "buffer", pickled
    np.savez(objects, data=np.array([Runs()], dtype=object))
    (folder / "objects.pkl").write_bytes(objects.getvalue())
    yield "an array of objects as buffer", "buffer", folder / "objects.pkl"
    yield from ((name, "checkpoint", path) for name, path in forged_checkpoints(folder))
    yield from ((name, "shown", path) for name, path in forged_folders(folder))


def load_paths() -> dict[str, list[Load]]:
    """All functions that load a file, by kind of file."""
    model, into_run, env = make(), make(env=make_vec_env("CartPole-v1")), make_vec_env("CartPole-v1")
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


TRUSTING: dict[str, Load] = {
    "model": lambda path: EqRQRDQN.load(path, trust=True),
    "buffer": lambda path: make().load_replay_buffer(path, trust=True),
    "shown": lambda path: make_env(load_model(path), path, trust=True),
}


def runs_code(load: Load, path: pathlib.Path) -> bool:
    """Whether loading a file, which may fail, runs the code that it names."""
    with contextlib.suppress(Exception), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        load(path)
    ran = RAN.exists()
    RAN.unlink(missing_ok=True)
    return ran


def strangers_files(folder: pathlib.Path) -> Finding:
    """Load each hostile file with each function for its kind."""
    trained(folder)
    ways, wrong, seconds = load_paths(), [], []
    files = list(hostile(folder))
    for name, kind, path in files:
        for number, load in enumerate(ways[kind]):
            began = time.monotonic()
            wrong += [f"{name}, way {number}: ran code"] if runs_code(load, path) else []
            seconds.append(time.monotonic() - began)
            wrong += [f"{name}, way {number}: {seconds[-1]:.0f} seconds"] if seconds[-1] > 10 else []
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # GB
    wrong += [f"{most:.1f} GB"] if most > 2 else []
    n_swapped = 200
    if swapped(folder, n_swapped):
        wrong.append("a file that is replaced while it is loaded: ran code")
    alive = sum(runs_code(TRUSTING[kind], path) for _, kind, path in files if kind in TRUSTING)
    found = f"{len(wrong)} did, {alive} ran code with trust; {max(seconds):.1f} s, {most:.1f} GB at most"
    wrong += [] if alive else ["none ran code with trust=True, so they prove nothing"]
    test = f"{len(files)} hostile files, {len(seconds) + n_swapped} loads"
    return Finding(test, "0 run code without trust=True, or take 10 s or 2 GB", found, wrong)


def swapped(folder: pathlib.Path, times: int) -> bool:
    """Whether loading a file that another thread replaces by a hostile one runs code."""
    good, evil = (folder / "model.zip").read_bytes(), (folder / "a pickle as policy.pth.zip").read_bytes()
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


def full_disk(folder: pathlib.Path) -> Finding:
    """Run an agent whose checkpoints fill a small disk."""
    folder.mkdir(parents=True)
    test, must = "a full disk (tmpfs of 2 MB)", "the last checkpoint is intact, and the message says so"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)], capture_output=True)
    if mounted.returncode != 0:
        return Finding(test, must, "cannot mount here", ["cannot mount here"])
    said = ""
    try:
        model = make(env=make_vec_env("CartPole-v1"), seed=0, buffer_size=20_000)
        try:
            model.learn(4_000, ExactCheckpointCallback(50, folder / "checkpoints", keep=1_000))
        except OSError as error:
            said = str(error).replace(str(folder), "FOLDER")
        step = EqRQRDQN.resume(folder / "checkpoints", make_vec_env("CartPole-v1")).num_timesteps
        wrong = partial_files(folder)
    finally:
        subprocess.run(["umount", str(folder)], check=False)
    wrong += [f"no {part!r}" for part in ("The last checkpoint, checkpoint-0", "No space left") if part not in said]
    wrong += [] if step > 0 else ["resumed at step 0"]
    return Finding(test, must, f"{said!r}; resumed at step {step}", wrong)
